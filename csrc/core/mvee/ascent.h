// Points of an overlap { max of two quadratics <= 0 }: fixed ones spread over its surface and its
// rim, and moving ones that climb to where the overlap reaches furthest out of an ellipsoid
// (docs/theory/mvee.md).
#pragma once

#include "core/mvee/barrier.h"
#include "core/mvee/pair.h"

namespace gsf {
namespace detail {

template <typename T>
GSF_HOST_DEVICE Vec3<T> matvec(const Sym3<T>& a, const Vec3<T>& v) {
  return {a.xx * v.x + a.xy * v.y + a.xz * v.z, a.xy * v.x + a.yy * v.y + a.yz * v.z,
          a.xz * v.x + a.yz * v.y + a.zz * v.z};
}

// Gauge of { y^T w y + 2 b.y <= 1 }: 1 on its surface, homogeneous of degree one.
template <typename T>
GSF_HOST_DEVICE T gauge(const Quadric<T>& q, const Vec3<T>& y) {
  using std::sqrt;
  const T b = dot(q.b, y), a = dot(y, matvec(q.w, y));
  const T root = sqrt(max(b * b + a, T(0)));
  return b > T(0) || a <= T(0) ? b + root : a / (root - b);  // no cancellation
}

// Direction i of n on the unit sphere, evenly spread (Fibonacci spiral).
template <typename T>
GSF_HOST_DEVICE Vec3<T> fibonacci_direction(int i, int n) {
  using std::cos;
  using std::sin;
  using std::sqrt;
  const T z = T(1) - (T(2) * T(i) + T(1)) / T(n);
  const T angle = T(2.399963229728653) * T(i);  // golden angle
  const T r = sqrt(max(T(1) - z * z, T(0)));
  return {r * cos(angle), r * sin(angle), z};
}

// The overlap of two quadratics around 0.
template <typename T>
struct Overlap {
  Quadric<T> a, b;

  // y pulled or pushed along its ray onto the surface.
  GSF_HOST_DEVICE Vec3<T> on_surface(const Vec3<T>& y) const {
    return (T(1) / max(gauge(a, y), gauge(b, y))) * y;
  }
  // Normal of a surface (half the gradient), and how far outside it y is (half the value).
  GSF_HOST_DEVICE static Vec3<T> normal(const Quadric<T>& q, const Vec3<T>& y) {
    return matvec(q.w, y) + q.b;
  }
  GSF_HOST_DEVICE static T outside(const Quadric<T>& q, const Vec3<T>& y) {
    return T(0.5) * (dot(y, matvec(q.w, y) + T(2) * q.b) - T(1));
  }
  // Shortest step that brings both values to zero, to first order; zero where the surfaces touch.
  GSF_HOST_DEVICE Vec3<T> to_rim(const Vec3<T>& y) const {
    const Vec3<T> na = normal(a, y), nb = normal(b, y);
    const T aa = dot(na, na), ab = dot(na, nb), bb = dot(nb, nb);
    const T det = aa * bb - ab * ab;
    if (!(det > T(1e-5) * aa * bb)) return {T(0), T(0), T(0)};
    const T fa = outside(a, y), fb = outside(b, y);
    const T ca = (fb * ab - fa * bb) / det, cb = (fa * ab - fb * aa) / det;
    return ca * na + cb * nb;
  }
  // The point of the rim near direction v, if the iteration gets there; a surface point in any
  // case.
  GSF_HOST_DEVICE Vec3<T> rim(const Vec3<T>& v) const {
    Vec3<T> y = on_surface(v);
    for (int i = 0; i < 5; ++i) {
      Vec3<T> step = to_rim(y);
      const T length = norm(step);
      if (length > T(0.5)) step = (T(0.5) / length) * step;
      y = on_surface(y + step);
    }
    return y;
  }
};

// The squared distance of a fit as a quadratic: (y - c)^T h (y - c).
template <typename T>
struct Objective {
  Sym3<T> h;
  Vec3<T> c;
  GSF_HOST_DEVICE explicit Objective(const LiftedFactor<T>& f) : c(f.mean) {
    const T* k = f.k;
    h = {k[0] * k[0] + k[1] * k[1] + k[3] * k[3],
         k[2] * k[2] + k[4] * k[4],
         k[5] * k[5],
         k[1] * k[2] + k[3] * k[4],
         k[3] * k[5],
         k[4] * k[5]};
  }
  // Half of it.
  GSF_HOST_DEVICE Vec3<T> gradient(const Vec3<T>& y) const { return matvec(h, y - c); }
};

inline constexpr double kReach = 0.25;  // longest step of a moving point

// One Newton step along the rim towards the largest objective; returns the squared step.
template <typename T>
GSF_HOST_DEVICE Vec3<T> climb_rim(const Overlap<T>& o, const Objective<T>& f, const Vec3<T>& y,
                                  T reach) {
  using std::abs;
  const Vec3<T> na = o.normal(o.a, y), nb = o.normal(o.b, y), g = f.gradient(y);
  const T aa = dot(na, na), ab = dot(na, nb), bb = dot(nb, nb);
  const T det = aa * bb - ab * ab;
  if (!(det > T(1e-5) * aa * bb)) return y;
  Vec3<T> t = cross(na, nb);
  t = (T(1) / norm(t)) * t;
  // g = alpha na + beta nb + slope t
  const T ga = dot(g, na), gb = dot(g, nb), slope = dot(g, t);
  const T alpha = (ga * bb - gb * ab) / det, beta = (gb * aa - ga * ab) / det;
  const T ca = dot(t, matvec(o.a.w, t)), cb = dot(t, matvec(o.b.w, t));
  const T bend = dot(t, matvec(f.h, t)) - alpha * ca - beta * cb;
  T step = bend < T(0) ? -slope / bend : (slope > T(0) ? reach : -reach);
  step = clamp(step, -reach, reach);
  // Second order along the curve: its curvature c has na.c = -ca, nb.c = -cb.
  const T pa = (cb * ab - ca * bb) / det, pb = (ca * ab - cb * aa) / det;
  const T half = T(0.5) * step * step;
  Vec3<T> z = y + step * t + (half * pa) * na + (half * pb) * nb;
  z = z + o.to_rim(z);
  return o.on_surface(z);
}

// One Newton step over the surface that y lies on.
template <typename T>
GSF_HOST_DEVICE Vec3<T> climb_cap(const Overlap<T>& o, const Objective<T>& f, const Vec3<T>& y,
                                  T reach) {
  using std::abs;
  using std::sqrt;
  const bool first = gauge(o.a, y) >= gauge(o.b, y);
  const Quadric<T>& q = first ? o.a : o.b;
  Vec3<T> n = o.normal(q, y);
  const Vec3<T> g = f.gradient(y);
  const T scale = T(1) / max(dot(n, n), T(1e-30)), alpha = dot(g, n) * scale;
  const Vec3<T> r = g - alpha * n;
  n = sqrt(scale) * n;
  // Tangent axes: the smallest component of n is replaced.
  const Vec3<T> e = abs(n.x) < T(0.6) ? Vec3<T>{T(1), T(0), T(0)} : Vec3<T>{T(0), T(1), T(0)};
  Vec3<T> t1 = cross(n, e);
  t1 = (T(1) / norm(t1)) * t1;
  const Vec3<T> t2 = cross(n, t1);
  const Vec3<T> h1 = matvec(f.h, t1) - alpha * matvec(q.w, t1);
  const Vec3<T> h2 = matvec(f.h, t2) - alpha * matvec(q.w, t2);
  const T a = dot(t1, h1), b = dot(t1, h2), d = dot(t2, h2), r1 = dot(t1, r), r2 = dot(t2, r);
  const T det = a * d - b * b;
  T s1 = r1, s2 = r2, longest = reach;
  if (a + d < T(0) && det > T(1e-4) * (a + d) * (a + d)) {
    s1 = (b * r2 - d * r1) / det;
    s2 = (b * r1 - a * r2) / det;
  } else {
    const T steep = sqrt(r1 * r1 + r2 * r2);
    const T up = steep > T(1e-6) ? reach / steep : T(0);
    s1 *= up;
    s2 *= up;
  }
  const T length = sqrt(s1 * s1 + s2 * s2);
  if (length > longest) {
    s1 *= longest / length;
    s2 *= longest / length;
  }
  return o.on_surface(y + s1 * t1 + s2 * t2);
}

// Up to `steps` steps from y, on the rim or on a cap, as long as they gain; returns the objective.
template <typename T>
GSF_HOST_DEVICE T climb(const Overlap<T>& o, const Objective<T>& f, const LiftedFactor<T>& factor,
                        bool rim, int steps, Vec3<T>& y) {
  T best = factor.distance(y), reach = T(kReach);
  for (int k = 0; k < steps; ++k) {
    const Vec3<T> after = rim ? climb_rim(o, f, y, reach) : climb_cap(o, f, y, reach);
    const T m = factor.distance(after);
    if (m > best) {
      best = m;
      y = after;
    } else {
      reach *= T(0.3);
    }
  }
  return best;
}

}  // namespace detail
}  // namespace gsf
