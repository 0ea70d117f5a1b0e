// gsfluent._core: the physics of csrc/core for one particle or one fit, from Python, in float32 and
// float64 (submodules of those names). For tests and material-point studies; tensors go through
// torch.ops.gsfluent.
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>

#include <stdexcept>
#include <string>
#include <vector>

#include "core/material/more_laws.h"
#include "core/mvee/lens.h"
#include "core/mvee/mvee.h"
#include "core/raster/order_free.h"

namespace py = pybind11;

namespace gsf {
namespace {

template <typename T>
using Array = py::array_t<T, py::array::c_style | py::array::forcecast>;

template <typename T>
const T* expect(const Array<T>& a, const char* name, std::vector<py::ssize_t> shape) {
  bool ok = a.ndim() == static_cast<py::ssize_t>(shape.size());
  for (size_t i = 0; ok && i < shape.size(); ++i) ok = shape[i] < 0 || a.shape(i) == shape[i];
  if (!ok) {
    std::string want;
    for (py::ssize_t s : shape)
      want += (want.empty() ? "" : ", ") + (s < 0 ? "N" : std::to_string(s));
    throw std::invalid_argument(std::string(name) + " must have shape [" + want + "]");
  }
  return a.data();
}

template <typename T>
Array<T> to_array(const Sym3<T>& s) {
  Array<T> a(6);
  store_sym3(a.mutable_data(), s);
  return a;
}
template <typename T>
Array<T> to_array(const Mat3<T>& m) {
  Array<T> a({3, 3});
  store_mat3(a.mutable_data(), m);
  return a;
}
template <typename T>
Array<T> to_array(const Vec3<T>& v) {
  Array<T> a(3);
  for (int i = 0; i < 3; ++i) a.mutable_data()[i] = v[i];
  return a;
}
template <typename T>
Vec3<T> vec3(const Array<T>& a, const char* name) {
  const T* p = expect(a, name, {3});
  return {p[0], p[1], p[2]};
}

template <typename T>
MaterialRow<T> material(T mu, T kappa, T strength, T cohesion, T hardening, T damage, T density,
                        T exponent) {
  return {mu, kappa, strength, cohesion, hardening, damage, density, exponent};
}

template <typename T>
py::dict one_particle(const Array<T>& strain, T alpha, const Array<T>& increment, int law,
                      const MaterialRow<T>& m, T k, T epsilon, bool implicit, T dt) {
  if (!is_law(law) && law != kYeoh && law != kOgden)
    throw std::invalid_argument("law must be 0 to 9");
  const ReturnMapped<T> r = return_mapping_more(load_sym3(expect(strain, "strain", {6})), alpha,
                                                load_mat3(expect(increment, "increment", {3, 3})),
                                                law, m, NaccOptions<T>{k, epsilon, implicit}, dt);
  py::dict d;
  d["strain"] = to_array(r.strain);
  d["stress"] = to_array(r.stress);
  d["alpha"] = r.alpha;
  d["plastic"] = r.plastic;
  d["guarded"] = r.guarded;
  d["inverted"] = r.inverted;
  d["invalid"] = r.invalid;
  return d;
}

template <typename T>
void bind(py::module_ m) {
  using py::arg;
  py::class_<MaterialRow<T>>(m, "Material", "One row of params (core/material/laws.h).")
      .def(py::init(&material<T>), arg("mu"), arg("kappa"), arg("strength") = T(0),
           arg("cohesion") = T(0), arg("hardening") = T(0), arg("damage") = T(0),
           arg("density") = T(1), arg("exponent") = T(0));
  m.def("return_mapping", &one_particle<T>, arg("strain"), arg("alpha"), arg("increment"),
        arg("law"), arg("material"), arg("k") = T(2), arg("epsilon") = T(0.1),
        arg("implicit") = true, arg("dt") = T(0),
        "One constitutive step of one particle (core/material/return_mapping.h).");
  m.def(
      "wave_speed_squared",
      [](const Array<T>& strain, int law, const MaterialRow<T>& material) {
        return wave_speed_squared_more(law, material, load_sym3(expect(strain, "strain", {6})));
      },
      arg("strain"), arg("law"), arg("material"),
      "Square of the fastest wave speed of one particle [m^2/s^2] (core/material/wave_speed.h).");
  m.def(
      "elastic_energy",
      [](const Array<T>& strain, T mu, T kappa) {
        const Sym3<T> e = load_sym3(expect(strain, "strain", {6}));
        return elastic_energy(mu, kappa, elastic_state(e, false));
      },
      arg("strain"), arg("mu"), arg("kappa"),
      "Stored energy per initial volume of one particle [J/m^3] (core/material/elastic.h).");
  m.def(
      "yield_surface",
      [](const MaterialRow<T>& r, T alpha) {
        const NaccMaterial<T> nacc{r.mu, r.kappa, r.strength, r.cohesion, r.hardening, r.damage};
        const YieldSurface<T> y = yield_surface(nacc, alpha);
        return py::make_tuple(y.p0, y.tip, y.center, y.a, y.b);
      },
      arg("material"), arg("alpha"), "(p0, -beta p0, centre, half-width, half-height) [Pa].");
  m.def(
      "svd3",
      [](const Array<T>& f) {
        const Svd3<T> r = svd3(load_mat3(expect(f, "f", {3, 3})));
        return py::make_tuple(to_array(r.u), to_array(r.sigma), to_array(r.v));
      },
      arg("f"), "(U, sigma, V) of F = U diag(sigma) V^T with rotations U, V (core/svd3.h).");
  m.def(
      "mvee",
      [](const Array<T>& points, double tolerance, int max_iterations) {
        const T* p = expect(points, "points", {-1, 3});
        const py::ssize_t n = points.shape(0);
        if (n < 1) throw std::invalid_argument("points must hold at least one point");
        std::vector<FitPoint<T>> scratch(n);
        const Ellipsoid<T> e = mvee_fit(SerialTeam{}, p, static_cast<int>(n), scratch.data(),
                                        tolerance, max_iterations);
        return py::make_tuple(to_array(e.center), to_array(to_mat3(e.shape)));
      },
      arg("points"), arg("tolerance") = 5e-4, arg("max_iterations") = 100,
      "(centre, shape) of the ellipsoid around one point set (core/mvee/mvee.h).");
  m.def(
      "order_free_sum",
      [](const Array<T>& values, double bound, int64_t most) {
        const T* v = expect(values, "values", {-1});
        const OrderFreeUnits units = OrderFreeUnits::of(bound, most);
        int64_t coarse = 0, fine = 0;
        for (py::ssize_t i = 0; i < values.shape(0); ++i) {
          int64_t c, f;
          if (!units.split(double(v[i]), &c, &f))
            throw std::invalid_argument("a value is not finite or above the bound");
          coarse += c;
          fine += f;
        }
        return units.value(coarse, fine);
      },
      arg("values"), arg("bound"), arg("most"),
      "Sum of at most `most` values up to `bound`, in any order (core/raster/order_free.h).");
  m.def(
      "ball_lens",
      [](T r1, T r2, T distance) {
        const BallLens<T> b = ball_lens(r1, r2, distance);
        return py::make_tuple(b.center, b.axial, b.radial, b.overlap);
      },
      arg("r1"), arg("r2"), arg("distance"),
      "(centre on the axis, axial, radial semi-axis, overlap) of two balls (core/mvee/pair.h).");
  m.def(
      "mvee_lens",
      [](const Array<T>& mean_a, const Array<T>& cov_a, const Array<T>& mean_b,
         const Array<T>& cov_b, double radius, double flat) {
        FitPoint<T> points[kLensPoints];
        const LensResult<T> r = mvee_lens(
            vec3(mean_a, "mean_a"), load_sym3(expect(cov_a, "cov_a", {6})), vec3(mean_b, "mean_b"),
            load_sym3(expect(cov_b, "cov_b", {6})), radius, flat, points);
        return py::make_tuple(to_array(r.mean), to_array(r.covariance), r.overlap);
      },
      arg("mean_a"), arg("cov_a"), arg("mean_b"), arg("cov_b"), arg("radius") = 2.0,
      arg("flat") = 0.0,
      "(mean, covariance, overlap) around one pair of Gaussians (core/mvee/lens.h).");
}

}  // namespace
}  // namespace gsf

PYBIND11_MODULE(_core, m) {
  m.doc() = "csrc/core for one particle or one fit; submodules float32 and float64.";
  gsf::bind<float>(m.def_submodule("float32"));
  gsf::bind<double>(m.def_submodule("float64"));
}
