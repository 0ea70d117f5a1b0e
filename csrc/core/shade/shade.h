// One pixel of a lit picture: from what the rasterizer blended to display values. The model, with
// every formula, is shade_image() in gsfluent/pipeline/light/shade.py; a test holds the two
// together.
#pragma once

#include "core/shade/shadow.h"

namespace gsf {

constexpr double kAlphaFloor = 1e-4;
constexpr double kOpaque = 0.999;  // what is behind such a pixel is not worked out
constexpr double kFaded = 1e-6;    // share below which the floor is left out
constexpr double kDisplayGamma = 2.2;
// Occlusion cones: levels, looks in cells of a level, own blur, filling, weight of the middle cone,
// tilt of the other four. Fitted, see gsfluent/pipeline/light/occlusion.py.
constexpr int kConeFirst = 1, kConeLast = 4;
constexpr double kConeReach = 2.16;
constexpr double kConeFlat = 0.02;
constexpr double kConeGain = 1.23;
constexpr double kConeCenter = 0.43;
constexpr double kConeCos = 0.445, kConeSin = 0.8955;

template <typename T>
GSF_HOST_DEVICE Vec3<T> to_linear(const Vec3<T>& c) {
  using std::pow;
  const T g = T(kDisplayGamma);
  return {pow(max(c.x, T(0)), g), pow(max(c.y, T(0)), g), pow(max(c.z, T(0)), g)};
}
template <typename T>
GSF_HOST_DEVICE Vec3<T> to_display(const Vec3<T>& c) {
  using std::pow;
  const T g = T(1.0 / kDisplayGamma);
  return {pow(max(c.x, T(0)), g), pow(max(c.y, T(0)), g), pow(max(c.z, T(0)), g)};
}
template <typename T>
GSF_HOST_DEVICE Vec3<T> times(const Vec3<T>& a, const Vec3<T>& b) {
  return {a.x * b.x, a.y * b.y, a.z * b.z};
}
template <typename T>
GSF_HOST_DEVICE Vec3<T> unit(const Vec3<T>& v) {
  return (T(1) / max(norm(v), T(kTinyLength))) * v;
}

// Environment light over pi at a unit normal, from coefficients [9, 3].
template <typename T>
GSF_HOST_DEVICE Vec3<T> irradiance(const T* e, const Vec3<T>& n) {
  const T basis[9] = {T(0.28209479177387814),
                      T(0.4886025119029199) * n.y,
                      T(0.4886025119029199) * n.z,
                      T(0.4886025119029199) * n.x,
                      T(1.0925484305920792) * n.x * n.y,
                      T(1.0925484305920792) * n.y * n.z,
                      T(0.31539156525252005) * (T(3) * n.z * n.z - T(1)),
                      T(1.0925484305920792) * n.x * n.z,
                      T(0.5462742152960396) * (n.x * n.x - n.y * n.y)};
  Vec3<T> sum{T(0), T(0), T(0)};
  for (int k = 0; k < 9; ++k) sum = sum + basis[k] * Vec3<T>{e[3 * k], e[3 * k + 1], e[3 * k + 2]};
  return {max(sum.x, T(0)), max(sum.y, T(0)), max(sum.z, T(0))};
}

// Trilinear value of one level of the pyramid, cell centres as nodes; 0 outside.
template <typename T>
GSF_HOST_DEVICE T sample_level(const T* values, int side, const Vec3<T>& place) {
  // Comparisons that NaN fails; most of a picture's looks end here.
  const T high = T(side);
  if (!(place.x > T(-1) && place.x < high && place.y > T(-1) && place.y < high && place.z > T(-1) &&
        place.z < high))
    return T(0);
  // Casts cut toward zero: shifted by one they round down.
  const int i = static_cast<int>(place.x + T(1)) - 1, j = static_cast<int>(place.y + T(1)) - 1,
            k = static_cast<int>(place.z + T(1)) - 1;
  const T fx = place.x - T(i), fy = place.y - T(j), fz = place.z - T(k);
  const int last = side - 1, layer = side * side;
  if (i >= 0 && j >= 0 && k >= 0 && i < last && j < last && k < last) {
    const T* v = values + (int64_t(k) * layer + j * side + i);
    const auto row = [&](const T* w) { return w[0] + fx * (w[1] - w[0]); };
    const T near0 = row(v), near1 = row(v + side), far0 = row(v + layer),
            far1 = row(v + layer + side);
    const T low = near0 + fy * (near1 - near0);
    return low + fz * (far0 + fy * (far1 - far0) - low);
  }
  T sum = T(0);
  for (int corner = 0; corner < 8; ++corner) {
    const int dx = corner & 1, dy = corner >> 1 & 1, dz = corner >> 2;
    const int x = i + dx, y = j + dy, z = k + dz;
    if (x < 0 || x >= side || y < 0 || y >= side || z < 0 || z >= side) continue;
    sum += (dx ? fx : T(1) - fx) * (dy ? fy : T(1) - fy) * (dz ? fz : T(1) - fz) *
           values[int64_t(z) * layer + y * side + x];
  }
  return sum;
}

// What one cone of weight 1 lets through from a point on.
template <typename T>
GSF_HOST_DEVICE T open_cone(const ShadeArgs<T>& a, const Vec3<T>& from, const Vec3<T>& way) {
  const T* values = a.occupancy;
  T left = T(1);
  for (int level = 0; level <= kConeLast; ++level) {
    const int side = a.nodes >> level;
    if (level >= kConeFirst) {
      const T scale = T(1) / T(1 << level), reach = T(kConeReach);
      const Vec3<T> place{scale * from.x + reach * way.x - T(0.5),
                          scale * from.y + reach * way.y - T(0.5),
                          scale * from.z + reach * way.z - T(0.5)};
      const T seen = sample_level(values, side, place) - T(kConeFlat);
      left *= max(T(1) - T(kConeGain / (1.0 - kConeFlat)) * max(seen, T(0)), T(0));
    }
    values += int64_t(side) * side * side;
  }
  return left;
}

// Share of the sky that reaches a point, by five cones; all of it without a normal.
template <typename T>
GSF_HOST_DEVICE T open_sky(const ShadeArgs<T>& a, const Vec3<T>& point, const Vec3<T>& normal) {
  using std::fabs;
  if (!a.occupancy || !(dot(normal, normal) > T(0.5))) return T(1);
  // In finest cells.
  const Vec3<T> from = (T(1) / a.grid_frame[3]) *
                       (point - Vec3<T>{a.grid_frame[0], a.grid_frame[1], a.grid_frame[2]});
  // Farther off than the longest look (and its interpolation) nothing can be seen.
  const T away = T((kConeReach + 1.0) * (1 << kConeLast)), end = T(a.nodes) + away;
  if (!(from.x > -away && from.x < end && from.y > -away && from.y < end && from.z > -away &&
        from.z < end))
    return T(1);
  const T steep = T(fabs(normal.x) > T(0.6)), gentle = T(1) - steep;
  const Vec3<T> across =
      unit(Vec3<T>{-normal.z * steep, normal.z * gentle, normal.x * steep - normal.y * gentle});
  const Vec3<T> other = cross(normal, across);
  T open = T(kConeCenter) * open_cone(a, from, normal);
  const T diagonal = T(kConeSin * 0.70710678118654752);
  for (int k = 0; k < 4; ++k) {
    const T p = k == 0 || k == 3 ? diagonal : -diagonal, q = k < 2 ? diagonal : -diagonal;
    const Vec3<T> way = T(kConeCos) * normal + p * across + q * other;
    open += T(0.25 * (1.0 - kConeCenter)) * open_cone(a, from, way);
  }
  return T(1) - a.occlusion * (T(1) - open);
}

// Unit vector from a point toward the lamp, and the lamp's falloff there.
template <typename T>
GSF_HOST_DEVICE Vec3<T> lamp_light(const T* lamp, const Vec3<T>& point, T* strength) {
  using std::pow;
  const Vec3<T> given{lamp[1], lamp[2], lamp[3]};
  *strength = T(1);
  if (!(lamp[0] > T(0.5))) return given;
  const Vec3<T> away = given - point;
  const T distance = max(norm(away), T(kTinyLength));
  *strength = pow(lamp[7] / distance, lamp[8]);
  return (T(1) / distance) * away;
}

template <typename Taps, typename T>
GSF_HOST_DEVICE Vec3<T> shade_surface(const ShadeArgs<T>& a, const Vec3<T>& point,
                                      const Vec3<T>& normal, const Vec3<T>& view,
                                      const Vec3<T>& albedo, T specular, T shininess) {
  using std::pow;
  Vec3<T> sum = open_sky(a, point, normal) * times(albedo, irradiance(a.environment, normal));
  for (int l = 0; l < a.lamp_count; ++l) {
    const T* lamp = a.lamps + kLampColumns * l;
    T strength;
    const Vec3<T> toward = lamp_light(lamp, point, &strength);
    const T facing = dot(normal, toward);
    if (!(facing > T(0))) continue;
    strength *= shadow_transmittance<Taps>(a, lamp, point, normal, T(1));
    const T along = max(dot(normal, unit(toward + view)), T(0));
    const T highlight = strength * specular * pow(along, shininess);
    const T diffuse = strength * facing;
    sum = sum + Vec3<T>{lamp[4] * (diffuse * albedo.x + highlight),
                        lamp[5] * (diffuse * albedo.y + highlight),
                        lamp[6] * (diffuse * albedo.z + highlight)};
  }
  return sum;
}

// Light on the floor, over pi; `bare`: without occlusion and shadows.
template <typename Taps, typename T>
GSF_HOST_DEVICE Vec3<T> floor_light(const ShadeArgs<T>& a, const Vec3<T>& point, bool bare) {
  const Vec3<T> up{T(0), T(0), T(1)};
  Vec3<T> sum = irradiance(a.environment, up);
  if (!bare) sum = open_sky(a, point, up) * sum;
  for (int l = 0; l < a.lamp_count; ++l) {
    const T* lamp = a.lamps + kLampColumns * l;
    T strength;
    const Vec3<T> toward = lamp_light(lamp, point, &strength);
    strength *= max(toward.z, T(0));
    if (!bare && strength > T(0)) strength *= shadow_transmittance<Taps>(a, lamp, point, up, T(0));
    sum = sum + strength * Vec3<T>{lamp[4], lamp[5], lamp[6]};
  }
  return sum;
}

// Floor and backdrop along a unit ray.
template <typename Taps, typename T>
GSF_HOST_DEVICE Vec3<T> shade_studio(const ShadeArgs<T>& a, const Vec3<T>& eye,
                                     const Vec3<T>& ray) {
  using std::exp;
  using std::sqrt;
  const T* s = a.studio;
  const T rise = clamp(T(2) * ray.z, T(0), T(1));
  Vec3<T> wall;
  for (int c = 0; c < 3; ++c) wall[c] = s[7 + c] + (s[10 + c] - s[7 + c]) * rise;
  const T down = -ray.z, above = eye.z - s[0];
  if (!(down > T(1e-4) && above > T(0))) return wall;
  const Vec3<T> point = eye + (above / down) * ray;
  const T dx = (point.x - s[1]) / s[3], dy = (point.y - s[2]) / s[3];
  const T keep = exp(-(dx * dx + dy * dy));
  if (!(keep > T(kFaded))) return wall;
  const Vec3<T> arrives = floor_light<Taps>(a, point, false);
  const Vec3<T> bare = floor_light<Taps>(a, Vec3<T>{s[1], s[2], s[0]}, true);
  const T open = max((bare.x + bare.y + bare.z) / T(3), T(1e-3));
  Vec3<T> mixed;
  for (int c = 0; c < 3; ++c)
    mixed[c] = keep * s[4 + c] * arrives[c] / open + (T(1) - keep) * wall[c];
  return mixed;
}

// `Taps`: how shadow maps are looked at.
template <typename Taps, typename T>
GSF_HOST_DEVICE void shade_pixel(const ShadeArgs<T>& a, int64_t column, int64_t line) {
  const int64_t pixel = line * a.width + column;
  const T *m = a.viewmat, *k = a.intrinsics;
  const T u = (T(column) + T(0.5) - k[2]) / k[0], v = (T(line) + T(0.5) - k[5]) / k[4];
  // Columns of the rotation times camera coordinates: back into the scene.
  const Vec3<T> forth{u * m[0] + v * m[4] + m[8], u * m[1] + v * m[5] + m[9],
                      u * m[2] + v * m[6] + m[10]};
  const Vec3<T> eye = T(-1) * Vec3<T>{m[3] * m[0] + m[7] * m[4] + m[11] * m[8],
                                      m[3] * m[1] + m[7] * m[5] + m[11] * m[9],
                                      m[3] * m[2] + m[7] * m[6] + m[11] * m[10]};
  const Vec3<T> ray = unit(forth);
  const T alpha = a.alpha[pixel], thick = max(alpha, T(kAlphaFloor));
  const T* blended = a.image + 3 * pixel;
  Vec3<T> front = (T(1) / thick) * Vec3<T>{blended[0], blended[1], blended[2]};
  if (alpha > T(kAlphaFloor)) {
    const T* vectors = a.normal + a.vectors * pixel;
    const Vec3<T> normal = unit(Vec3<T>{vectors[0], vectors[1], vectors[2]});
    const T specular = a.gloss ? a.gloss[0] : vectors[3] / thick;
    const T shininess = a.gloss ? a.gloss[1] : vectors[4] / thick;
    const Vec3<T> point = eye + a.depth[pixel] * forth;
    front = to_display(
        shade_surface<Taps>(a, point, normal, T(-1) * ray, to_linear(front), specular, shininess));
  }
  const T cover = alpha > T(kOpaque) ? T(1) : alpha;
  Vec3<T> behind{a.background[0], a.background[1], a.background[2]};
  if (a.studio && cover < T(1)) behind = to_display(shade_studio<Taps>(a, eye, ray));
  for (int c = 0; c < 3; ++c)
    a.out[3 * pixel + c] = clamp(front[c] * cover + behind[c] * (T(1) - cover), T(0), T(1));
}

}  // namespace gsf
