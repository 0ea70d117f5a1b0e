// Face elements: flat Gaussians on the planes halfway between points that have come apart
// (gsfluent/pipeline/cracks/faces.py says what they are).
#pragma once

#include <limits>

#include "core/deform/args.h"
#include "core/deform/carry.h"
#include "core/vec.h"

namespace gsf {

// The face between the cell of a site's own point and that of a neighbour.
template <typename T>
struct Face {
  Vec3<T> normal;  // away from the own point; 0 for the point itself
  T reach;         // distance of the site from the plane [m]
};

// Where a site is, and its own point and neighbours; `ok` is false for rows that are none.
template <typename T>
struct FaceSite {
  bool ok;
  int64_t own;
  Vec3<T> middle, home;
  T pitch, away;  // `away`: squared distance from its own point

  GSF_HOST_DEVICE FaceSite(const FaceArgs<T>& a, int64_t site) {
    ok = site >= 0 && site < a.sites;
    own = ok ? a.owner[site] : -1;
    ok = ok && own >= 0 && own < a.points;
    if (!ok) return;
    middle = load_vec3(a.means + 3 * site);
    home = load_vec3(a.rest + 3 * own);
    pitch = a.pitch[site];
    const Vec3<T> out = middle - home;
    away = dot(out, out);
  }
  GSF_HOST_DEVICE int64_t neighbour(const FaceArgs<T>& a, int k) const {
    const int64_t j = a.near[own * a.near_count + k];
    return j >= 0 && j < a.points ? j : own;
  }
  GSF_HOST_DEVICE bool gone(const FaceArgs<T>& a, int k) const {
    return a.opened[own * a.near_count + k];
  }
  GSF_HOST_DEVICE Face<T> face(const FaceArgs<T>& a, int k) const {
    const Vec3<T> point = load_vec3(a.rest + 3 * neighbour(a, k));
    const Vec3<T> across = point - home, other = point - middle;
    const T width = max(norm(across), T(1e-12));
    return {(T(1) / width) * across, (dot(other, other) - away) / (T(2) * width)};
  }
};

template <typename T>
GSF_HOST_DEVICE T one_norm(const Vec3<T>& v) {
  using std::abs;
  return abs(v.x) + abs(v.y) + abs(v.z);
}

// The opened neighbour whose face is nearest, the first of equals, and how far that is.
template <typename T>
GSF_HOST_DEVICE int nearest_face(const FaceArgs<T>& a, const FaceSite<T>& s, T* gap) {
  int best = 0;
  *gap = std::numeric_limits<T>::infinity();
  for (int k = 0; k < a.near_count; ++k) {
    if (!s.gone(a, k)) continue;
    const T reach = s.face(a, k).reach;
    if (reach < *gap) {
      *gap = reach;
      best = k;
    }
  }
  return best;
}

// Whether site i has an element on the face to neighbour k, or, for k = K, one of the skin along
// the rim of a face.
template <typename T>
GSF_HOST_DEVICE bool has_face(const FaceArgs<T>& a, int64_t i, int k) {
  const int64_t site = a.rows[i];
  const FaceSite<T> s(a, site);
  if (!s.ok) return false;
  if (k == a.near_count) {
    const T skin = a.fit.layer * s.pitch * one_norm(load_vec3(a.outward + 3 * site));
    T gap;
    nearest_face(a, s, &gap);
    return a.depth[site] < skin && gap < a.fit.rim * s.pitch;
  }
  if (!s.gone(a, k)) return false;
  const Face<T> face = s.face(a, k);
  if (!(face.reach < a.fit.layer * s.pitch * one_norm(face.normal))) return false;
  // Where a third point's cell begins the face has ended.
  const Vec3<T> spot = s.middle + face.reach * face.normal;
  const T least = norm(s.home - spot) - a.fit.overlap * s.pitch;
  for (int n = 0; n < a.near_count; ++n)
    if (!(norm(load_vec3(a.rest + 3 * s.neighbour(a, n)) - spot) >= least)) return false;
  return true;
}

template <typename T>
GSF_HOST_DEVICE Vec3<T> unit_or_zero(const Vec3<T>& v) {
  return (T(1) / max(norm(v), T(1e-12))) * v;
}

// Element i: of site rows[i] at the face to column[i], or at the rim.
template <typename T>
GSF_HOST_DEVICE void face_element(const FaceArgs<T>& a, int64_t i) {
  using std::abs;
  using std::sqrt;
  const int64_t site = a.rows[i], wanted = a.column[i];
  const FaceSite<T> s(a, site);
  const bool ok = s.ok && wanted >= 0 && wanted <= a.near_count;
  a.rival[i] = 0;
  for (int k = 0; k < 3; ++k) {
    a.out_means[3 * i + k] = a.out_normals[3 * i + k] = T(0);
    a.out_scales[3 * i + k] = T(0);
  }
  for (int k = 0; k < 4; ++k) a.out_quats[4 * i + k] = T(k == 0);
  if (!ok) return;

  Vec3<T> normal, edge;
  T reach, room;
  const Vec3<T> outward = load_vec3(a.outward + 3 * site);
  if (wanted == a.near_count) {
    const int best = nearest_face(a, s, &room);
    a.rival[i] = best;
    normal = outward;
    reach = a.depth[site];
    edge = s.face(a, best).normal;
    room = max(room, T(0));
  } else {
    a.rival[i] = wanted;
    const Face<T> own = s.face(a, static_cast<int>(wanted));
    normal = own.normal;
    reach = max(own.reach, T(0));
    // Its nearest edge: another face, or the skin.
    room = std::numeric_limits<T>::infinity();
    edge = s.face(a, 0).normal;
    for (int k = 0; k <= a.near_count; ++k) {
      if (k < a.near_count && (k == wanted || !s.gone(a, k))) continue;
      const Face<T> face = k < a.near_count ? s.face(a, k) : Face<T>{outward, a.depth[site]};
      const T tilt = dot(face.normal, normal);
      const T slope = sqrt(max(T(1) - tilt * tilt, T(0)));
      if (!(slope > a.fit.steep)) continue;
      const T way = (face.reach - own.reach * tilt) / max(slope, a.fit.steep);
      if (way < room) {
        room = way;
        edge = face.normal;
      }
    }
  }

  // First axis: in the face, toward the edge.
  const Vec3<T> along = edge - dot(edge, normal) * normal;
  const bool flat = norm(along) < a.fit.steep;
  int least = 0;
  for (int k = 1; k < 3; ++k)
    if (abs(normal[k]) < abs(normal[least])) least = k;
  const Vec3<T> axis = {T(least == 0), T(least == 1), T(least == 2)};
  const Vec3<T> first = unit_or_zero(flat ? cross(normal, axis) : along);
  const Vec3<T> second = cross(normal, first);
  Mat3<T> axes;
  for (int k = 0; k < 3; ++k) {
    axes(k, 0) = first[k];
    axes(k, 1) = second[k];
    axes(k, 2) = normal[k];
  }
  quat_from_rotation(axes, a.out_quats + 4 * i);
  const T width = a.fit.width * s.pitch;
  const T narrow = min(width, max(room / a.fit.edge, a.fit.narrowest * width));
  store_vec3(a.out_means + 3 * i, s.middle + (reach - a.fit.inset * s.pitch) * normal);
  store_vec3(a.out_scales + 3 * i,
             Vec3<T>{flat ? width : narrow, width, a.fit.thickness * s.pitch});
  store_vec3(a.out_normals + 3 * i, normal);
}

}  // namespace gsf
