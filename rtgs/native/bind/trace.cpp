// Binding of the surfel tracer: owns the memory, calls the kernels of the active instruction set in their order.
// Shapes, dtypes and values are checked by rtgs/render/trace.py.
#include <nanobind/stl/optional.h>
#include <nanobind/stl/unique_ptr.h>

#include <algorithm>
#include <optional>
#include <stdexcept>

#include "bind/bindings.h"
#include "trace/bvh_tree.h"
#include "common/isa.h"
#include "common/threads.h"
#include "trace/state.h"

namespace rtgs {
namespace {

using MaybeFloats = std::optional<Floats>;

float* data_or_null(const MaybeFloats& array) { return array ? array->data() : nullptr; }

#if defined(RTGS_HAS_avx512)
#define RTGS_CALL(isa, function, ...)                                                                \
  ((isa) == Isa::avx512 ? avx512::function(__VA_ARGS__)                                              \
   : (isa) == Isa::avx2 ? avx2::function(__VA_ARGS__) : portable::function(__VA_ARGS__))
#else
#define RTGS_CALL(isa, function, ...) portable::function(__VA_ARGS__)
#endif

SurfelArrays geometry_arrays(const Floats& means, const Floats& tangent_u, const Floats& tangent_v, const Floats& scales,
                             const Floats& opacities) {
  return {int64_t(means.shape(0)), 0, means.data(), tangent_u.data(), tangent_v.data(), scales.data(), opacities.data(),
          nullptr};
}

// One trace: made by the forward pass, kept alive by autograd until the backward pass is done.
class Tracing {
 public:
  Tracing(float transmittance_cutoff, float alpha_cutoff, int sh_degree, bool last_sh, bool raw_sh,
          const std::string& order, int threads)
      : isa_(active_isa()), options_{transmittance_cutoff, alpha_cutoff, last_sh, raw_sh, checked_threads(threads)},
        sh_degree_(sh_degree), order_(order), memory_(TraceMemoryPool::instance().take()) {
    if (order != "given" && order != "sorted" && order != "auto")
      throw std::invalid_argument("trace: order '" + order + "' is not one of given, sorted, auto");
    memory_->set_threads(options_.threads);
  }
  ~Tracing() { TraceMemoryPool::instance().give(std::move(memory_)); }

  void forward(const SurfelTree& tree, Floats means, Floats tangent_u, Floats tangent_v, Floats scales, Floats opacities,
               MaybeFloats features, MaybeFloats sh_dc, MaybeFloats sh_rest, Floats origins, Floats directions,
               MaybeFloats t_min_each, MaybeFloats t_max_each, float t_min, float t_max, bool keep,
               MaybeFloats out_colors, MaybeFloats out_features, Floats out_alpha, MaybeFloats out_depth,
               MaybeFloats out_normal, MaybeFloats out_weight_sum) {
    nb::gil_scoped_release release;
    kept_ = false;
    TraceMemory& m = *memory_;
    surfels_ = trace_surfels(means, tangent_u, tangent_v, scales, opacities, features, sh_dc, sh_rest);
    const int64_t count = surfels_.arrays.count;
    if (tree.surfels() != count)
      throw std::invalid_argument("trace: the tree holds " + std::to_string(tree.surfels()) + " surfels, got " +
                                  std::to_string(count) + "; build it on the same surfels");
    if (count && tree.alpha_cutoff() > options_.alpha_cutoff)
      throw std::invalid_argument("trace: the tree was built for a larger alpha cutoff than the trace's; build it anew");
    TraceForwardArgs args{};
    args.surfels = surfels_;
    args.rays = trace_rays(origins, directions);
    args.rays.t_min_each = data_or_null(t_min_each);
    args.rays.t_max_each = data_or_null(t_max_each);
    args.rays.t_min = t_min;
    args.rays.t_max = t_max;
    args.options = options_;
    args.tree = tree.view();
    sorted_ = order_ != "given" && sort_rays(args.rays, args.tree);
    args.rays.order = sorted_ ? m.order.get() : nullptr;
    float* records = m.records.reserve(kTraceFields * (count + 1));
    SlotBoxes* boxes = m.boxes.reserve(count / kSlotsPerBlock + 1);
    RTGS_CALL(isa_, trace_records, surfels_.arrays, args.tree, options_.alpha_cutoff, records,
              boxes, m.slots.reserve(count + 1), options_.threads);
    args.records = records, args.boxes = boxes;
    packets_ = (args.rays.count + RTGS_CALL(isa_, packet_lanes) - 1) / RTGS_CALL(isa_, packet_lanes);
    if (keep || out_weight_sum) args.tapes = m.tapes.reserve(packets_ + 1);
    std::vector<TapeArena> arenas = fresh_arenas(m.tape_blocks);
    args.arenas = arenas.data();
    args.workspaces = m.workspaces.data();
    args.colors = data_or_null(out_colors);
    args.features = data_or_null(out_features);
    args.alpha = out_alpha.data();
    args.depth = data_or_null(out_depth);
    args.normal = data_or_null(out_normal);
    RTGS_CALL(isa_, trace_forward, args);
    if (out_weight_sum) RTGS_CALL(isa_, sum_packet_weights, args, out_weight_sum->data());
    hits_ = args.hits;
    kept_ = keep;
  }

  // Sums over the rays into the memory, then the chain rule of the surfels into the given arrays.
  void backward(Floats means, Floats tangent_u, Floats tangent_v, Floats scales, Floats opacities, MaybeFloats features,
                MaybeFloats sh_dc, MaybeFloats sh_rest, Floats origins, Floats directions, MaybeFloats colors,
                MaybeFloats features_traced, Floats alpha, MaybeFloats depth, MaybeFloats normal,
                MaybeFloats grad_colors, MaybeFloats grad_features, MaybeFloats grad_alpha, MaybeFloats grad_depth,
                MaybeFloats grad_normal, MaybeFloats out_means, MaybeFloats out_tangent_u, MaybeFloats out_tangent_v,
                MaybeFloats out_scales, MaybeFloats out_opacities, MaybeFloats out_features, MaybeFloats out_sh_dc,
                MaybeFloats out_sh_rest, MaybeFloats out_origins, MaybeFloats out_directions, MaybeFloats out_probe) {
    nb::gil_scoped_release release;
    if (!kept_) throw std::logic_error("trace: backward needs a forward pass with keep=True");
    TraceMemory& m = *memory_;
    int poisoned = 0;
    TraceBackwardArgs args{};
    args.surfels = trace_surfels(means, tangent_u, tangent_v, scales, opacities, features, sh_dc, sh_rest);
    args.rays = trace_rays(origins, directions);
    args.options = options_;
    args.records = m.records.get();
    args.tapes = m.tapes.get();
    args.workspaces = m.workspaces.data();
    args.colors = data_or_null(colors);
    args.features = data_or_null(features_traced);
    args.alpha = alpha.data();
    args.depth = data_or_null(depth);
    args.normal = data_or_null(normal);
    args.grad_colors = data_or_null(grad_colors);
    args.grad_features = data_or_null(grad_features);
    args.grad_alpha = data_or_null(grad_alpha);
    args.grad_depth = data_or_null(grad_depth);
    args.grad_normal = data_or_null(grad_normal);
    const TraceGradients out = {data_or_null(out_means),     data_or_null(out_tangent_u), data_or_null(out_tangent_v),
                                data_or_null(out_scales),    data_or_null(out_opacities), data_or_null(out_features),
                                data_or_null(out_sh_dc),     data_or_null(out_sh_rest),   data_or_null(out_probe)};
    args.out_origins = data_or_null(out_origins);
    args.out_directions = data_or_null(out_directions);
    args.ray_gradients = out_origins || out_directions;
    args.surfel_gradients = out.any();
    args.poisoned = &poisoned;
    const int64_t count = args.surfels.arrays.count;
    args.row_stride = RTGS_CALL(isa_, trace_row_stride, args.surfels);
    args.first_coefficient = RTGS_CALL(isa_, first_coefficient, args.surfels);
    if (args.surfel_gradients) args.rows = m.rows.reserve(count * args.row_stride + 64);
    args.touched = m.touched.reserve(count + 1);
    std::fill_n(args.touched, count, uint8_t(0));
    args.groups = m.groups.reserve(packets_ + 1);
    RTGS_CALL(isa_, trace_backward, args);
    if (args.surfel_gradients) RTGS_CALL(isa_, trace_surfel_gradients, args, m.slots.get(), out, !poisoned);
  }

  int64_t hits() const { return hits_; }
  std::string order_used() const { return sorted_ ? "sorted" : "given"; }

 private:
  TraceSurfels trace_surfels(const Floats& means, const Floats& tangent_u, const Floats& tangent_v, const Floats& scales,
                             const Floats& opacities, const MaybeFloats& features, const MaybeFloats& sh_dc,
                             const MaybeFloats& sh_rest) const {
    TraceSurfels s{};
    s.arrays = geometry_arrays(means, tangent_u, tangent_v, scales, opacities);
    if (features) s.arrays.features = features->data(), s.arrays.channels = int(features->shape(1));
    if (sh_dc) {
      if (!sh_rest || sh_rest->ndim() != 3) throw std::invalid_argument("trace: sh_dc needs sh_rest (N, K, 3)");
      s.sh_dc = sh_dc->data(), s.sh_rest = sh_rest->data(), s.rest = int(sh_rest->shape(1));
      while (s.degree < sh_degree_ && (s.degree + 2) * (s.degree + 2) - 1 <= s.rest) ++s.degree;
    }
    return s;
  }

  TraceRays trace_rays(const Floats& origins, const Floats& directions) const {
    TraceRays rays{};
    rays.count = int64_t(origins.shape(0));
    rays.origins = origins.data();
    rays.directions = directions.data();
    rays.order = sorted_ ? memory_->order.get() : nullptr;
    return rays;
  }

  bool sort_rays(const TraceRays& rays, const TreeView& tree) {
    TraceMemory& m = *memory_;
    RayOrderArgs args{};
    args.rays = rays;
    args.tree = tree;
    args.always = order_ == "sorted";
    args.coordinates = m.coordinates.reserve(5 * (rays.count + 1));
    args.keys = m.keys.reserve(rays.count + 1);
    args.spare = m.spare_keys.reserve(rays.count + 1);
    args.scratch = m.scratch.reserve(RTGS_CALL(isa_, order_scratch));
    args.order = m.order.reserve(rays.count + 16);
    args.threads = options_.threads;
    return RTGS_CALL(isa_, order_rays, args);
  }

  std::vector<TapeArena> fresh_arenas(std::vector<ArenaBlocks>& blocks) const {
    std::vector<TapeArena> arenas;
    for (int thread = 0; thread < options_.threads; ++thread) {
      blocks[size_t(thread)].reset();
      arenas.push_back(blocks[size_t(thread)].arena());
    }
    return arenas;
  }

  Isa isa_;
  TraceOptionsNative options_;
  int sh_degree_;
  std::string order_;
  bool sorted_ = false, kept_ = false;
  TraceSurfels surfels_{};
  int64_t packets_ = 0, hits_ = 0;
  std::unique_ptr<TraceMemory> memory_;
};

}  // namespace

void bind_trace(nb::module_& m) {
  nb::class_<SurfelTree>(m, "SurfelTree", "Hierarchy of surfel bounds; see rtgs/render/trace.py.")
      .def(nb::init<>())
      .def("build", [](SurfelTree& tree, Floats means, Floats tangent_u, Floats tangent_v, Floats scales, Floats opacities,
                       float alpha_cutoff, int threads) {
        nb::gil_scoped_release release;
        tree.build(geometry_arrays(means, tangent_u, tangent_v, scales, opacities), alpha_cutoff, checked_threads(threads));
      }, nb::arg("means"), nb::arg("tangent_u"), nb::arg("tangent_v"), nb::arg("scales"), nb::arg("opacities"),
         nb::arg("alpha_cutoff"), nb::arg("threads"))
      .def("refit", [](SurfelTree& tree, Floats means, Floats tangent_u, Floats tangent_v, Floats scales, Floats opacities,
                       float alpha_cutoff, int threads) {
        nb::gil_scoped_release release;
        tree.refit(geometry_arrays(means, tangent_u, tangent_v, scales, opacities), alpha_cutoff, checked_threads(threads));
      }, nb::arg("means"), nb::arg("tangent_u"), nb::arg("tangent_v"), nb::arg("scales"), nb::arg("opacities"),
         nb::arg("alpha_cutoff"), nb::arg("threads"))
      .def_prop_ro("nodes", &SurfelTree::nodes)
      .def_prop_ro("surfels", &SurfelTree::surfels, "number of surfels of the last build")
      .def_prop_ro("surface_cost", &SurfelTree::surface_cost, "expected tests of a ray that meets the root; 0 if empty");
  nb::class_<Tracing>(m, "Tracing", "One trace of rays through surfels; see rtgs/render/trace.py.")
      .def(nb::init<float, float, int, bool, bool, const std::string&, int>(), nb::arg("transmittance_cutoff"),
           nb::arg("alpha_cutoff"), nb::arg("sh_degree"), nb::arg("last_sh"), nb::arg("raw_sh"),
           nb::arg("order"), nb::arg("threads"))
      .def("forward", &Tracing::forward, nb::arg("tree"), nb::arg("means"), nb::arg("tangent_u"), nb::arg("tangent_v"),
           nb::arg("scales"), nb::arg("opacities"), nb::arg("features").none(), nb::arg("sh_dc").none(),
           nb::arg("sh_rest").none(), nb::arg("origins"), nb::arg("directions"), nb::arg("t_min_each").none(),
           nb::arg("t_max_each").none(), nb::arg("t_min"), nb::arg("t_max"), nb::arg("keep"),
           nb::arg("out_colors").none(), nb::arg("out_features").none(), nb::arg("out_alpha"),
           nb::arg("out_depth").none(), nb::arg("out_normal").none(), nb::arg("out_weight_sum").none())
      .def("backward", &Tracing::backward, nb::arg("means"), nb::arg("tangent_u"), nb::arg("tangent_v"),
           nb::arg("scales"), nb::arg("opacities"), nb::arg("features").none(), nb::arg("sh_dc").none(),
           nb::arg("sh_rest").none(), nb::arg("origins"), nb::arg("directions"), nb::arg("colors").none(),
           nb::arg("features_traced").none(), nb::arg("alpha"), nb::arg("depth").none(), nb::arg("normal").none(),
           nb::arg("grad_colors").none(), nb::arg("grad_features").none(), nb::arg("grad_alpha").none(),
           nb::arg("grad_depth").none(), nb::arg("grad_normal").none(), nb::arg("out_means").none(),
           nb::arg("out_tangent_u").none(), nb::arg("out_tangent_v").none(), nb::arg("out_scales").none(),
           nb::arg("out_opacities").none(), nb::arg("out_features").none(), nb::arg("out_sh_dc").none(),
           nb::arg("out_sh_rest").none(), nb::arg("out_origins").none(), nb::arg("out_directions").none(),
           nb::arg("out_probe").none())
      .def_prop_ro("hits", &Tracing::hits, "(ray, surfel) hits composited by forward")
      .def_prop_ro("order_used", &Tracing::order_used);
  m.def("release_trace_memory", [] { TraceMemoryPool::instance().clear(); },
        "Give idle tracer memory back to the system.");
}

}  // namespace rtgs
