// Checks and allocation of the ops on graphs, once for both back ends.
#pragma once

#include "core/graph.h"
#include "torch_api.h"

namespace gsf {

template <class Backend>
struct GraphOps {
  static std::tuple<Tensor, Tensor, Tensor> link_costs(Tensor links, Tensor length, Tensor spacing,
                                                       Tensor position, Tensor broken,
                                                       Tensor flowing, Tensor may_break,
                                                       OptTensor gone, Tensor before, double open,
                                                       double torn, double steep, double unit,
                                                       int64_t shift) {
    const char* op = "link_costs";
    links = ready(op, "links", links, links, {-1, 2}, ScalarType::Long);
    const int64_t count = links.size(0), points = position.size(0);
    length = ready(op, "length", length, links, {count}, ScalarType::Double);
    before = ready(op, "before", before, links, {count}, ScalarType::Bool);
    position = ready(op, "position", position, links, {points, 3}, ScalarType::Double);
    spacing = ready(op, "spacing", spacing, links, {points}, ScalarType::Double);
    broken = ready(op, "broken", broken, links, {points}, ScalarType::Bool);
    flowing = ready(op, "flowing", flowing, links, {points}, ScalarType::Bool);
    may_break = ready(op, "may_break", may_break, links, {points}, ScalarType::Bool);
    gone = ready(op, "gone", gone, links, {points}, ScalarType::Bool);
    STD_TORCH_CHECK(shift >= 0 && shift <= 30, op, ": shift must be 0 to 30, got ", shift);
    Tensor cut = gsf::new_empty(links, {count}, ScalarType::Bool);
    Tensor cost = gsf::new_empty(links, {count}, ScalarType::Long);
    Tensor ends = gsf::new_zeros(links, {points}, ScalarType::Bool);
    const LinkCostsArgs args{{count, points, cptr<int64_t>(links)},
                             cptr<double>(length),
                             cptr<double>(spacing),
                             cptr<double>(position),
                             cptr<bool>(broken),
                             cptr<bool>(flowing),
                             cptr<bool>(may_break),
                             cptr<bool>(gone),
                             cptr<bool>(before),
                             open,
                             torn,
                             steep,
                             unit,
                             static_cast<int>(shift),
                             mptr<bool>(cut),
                             mptr<int64_t>(cost),
                             mptr<bool>(ends)};
    const typename Backend::Scope scope(links);
    Backend::link_costs(args, scope);
    return {cut, cost, ends};
  }

  static Tensor components(Tensor links, int64_t points, OptTensor apart, OptTensor inside) {
    const char* op = "components";
    links = ready(op, "links", links, links, {-1, 2}, ScalarType::Long);
    STD_TORCH_CHECK(points >= 0, op, ": count must not be negative, got ", points);
    apart = ready(op, "apart", apart, links, {links.size(0)}, ScalarType::Bool);
    inside = ready(op, "inside", inside, links, {points}, ScalarType::Bool);
    Tensor root = gsf::new_empty(links, {points}, ScalarType::Long);
    const ComponentsArgs args{{links.size(0), points, cptr<int64_t>(links)},
                              cptr<bool>(apart),
                              cptr<bool>(inside),
                              mptr<int64_t>(root)};
    const typename Backend::Scope scope(links);
    Backend::components(args, scope);
    return root;
  }

  static Tensor nearest_seeds(Tensor links, Tensor cost, Tensor key, Tensor other) {
    const char* op = "nearest_seeds";
    links = ready(op, "links", links, links, {-1, 2}, ScalarType::Long);
    const int64_t count = links.size(0), points = key.size(0);
    cost = ready(op, "cost", cost, links, {count}, ScalarType::Long);
    key = ready(op, "key", key, links, {points}, ScalarType::Long);
    other = ready(op, "other", other, links, {points}, ScalarType::Bool);
    Tensor found = torch::stable::clone(key);
    const typename Backend::Scope scope(links);
    Tensor leads = gsf::new_empty(links, {count + 2}, ScalarType::Long);
    const NearestSeedsArgs args{{count, points, cptr<int64_t>(links)},
                                cptr<int64_t>(cost),
                                cptr<bool>(other),
                                mptr<int64_t>(found),
                                mptr<int64_t>(leads)};
    Backend::nearest_seeds(args, scope);
    return found;
  }

  template <typename Library>
  static void register_all(Library& m) {
    GSF_IMPL(GraphOps, link_costs);
    GSF_IMPL(GraphOps, components);
    GSF_IMPL(GraphOps, nearest_seeds);
  }
};

}  // namespace gsf
