#include "common/parallel.h"
#include "trace/bvh_tree.h"

#include <algorithm>
#include <limits>
#include <stdexcept>
#include <string>

#include "common/isa.h"
#if defined(__SSE2__)
#include <emmintrin.h>
#endif

namespace rtgs {
namespace {

constexpr float kHuge = std::numeric_limits<float>::max();

typedef float Float4 __attribute__((vector_size(16)));
Float4 load4(const float* p) {
  Float4 v;
  __builtin_memcpy(&v, p, sizeof v);
  return v;
}
Float4 min4(Float4 a, Float4 b) {
#if defined(__SSE2__)
  return (Float4)_mm_min_ps((__m128)a, (__m128)b);
#else
  return a < b ? a : b;
#endif
}
Float4 max4(Float4 a, Float4 b) {
#if defined(__SSE2__)
  return (Float4)_mm_max_ps((__m128)a, (__m128)b);
#else
  return a > b ? a : b;
#endif
}

struct Bounds {
  Float4 low = Float4{} + kHuge, high = Float4{} - kHuge;
  void add(const SurfelBox& box) { low = min4(low, load4(box.low)), high = max4(high, load4(box.high)); }
  void add(const Bounds& other) { low = min4(low, other.low), high = max4(high, other.high); }
  float half_area() const {
    const Float4 d = high - low;
    return d[0] < 0.f ? 0.f : d[0] * d[1] + d[1] * d[2] + d[2] * d[0];
  }
};

// Twice the centre; of an empty box (huge, -huge) zero.
Float4 doubled_centre(const SurfelBox& box) { return load4(box.low) + load4(box.high); }

void store_bounds(TreeNode& node, int child, const Bounds& bounds) {
  for (int k = 0; k < 3; ++k) node.low[k][child] = bounds.low[k], node.high[k][child] = bounds.high[k];
}
Bounds child_bounds(const TreeNode& node, int child) {
  Bounds b;
  for (int k = 0; k < 3; ++k) b.low[k] = node.low[k][child], b.high[k] = node.high[k][child];
  return b;
}

// Surface area heuristic over equal bins of the centres, all three axes at once.
constexpr int kMostBins = 16;
struct Binning {
  Float4 origin, scale;
  int bins;
  Binning(Float4 low, Float4 high, int64_t count) : origin(low), bins(count < 64 ? 8 : kMostBins) {
    const Float4 extent = high - low;
    for (int k = 0; k < 4; ++k) scale[k] = k < 3 && extent[k] > 0.f ? float(bins) * 0.9999f / extent[k] : 0.f;
  }
  int bin(Float4 centre, int axis) const {
    const int b = int((centre[axis] - origin[axis]) * scale[axis]);
    return b < 0 ? 0 : b >= bins ? bins - 1 : b;
  }
};
struct Cut {
  int axis = -1, first_right_bin = 0;
  float cost = kHuge;
};

void consider_axis(const Bounds* bounds, const int64_t* counts, int bins, int axis, Cut& best) {
  float right_cost[kMostBins];
  Bounds sum;
  int64_t count = 0;
  for (int b = bins - 1; b > 0; --b) {
    sum.add(bounds[b]);
    count += counts[b];
    right_cost[b] = count ? sum.half_area() * float(count) : -1.f;
  }
  sum = Bounds();
  count = 0;
  for (int b = 0; b + 1 < bins; ++b) {
    sum.add(bounds[b]);
    count += counts[b];
    if (!count || right_cost[b + 1] < 0.f) continue;
    const float cost = sum.half_area() * float(count) + right_cost[b + 1];
    if (cost < best.cost) best = {axis, b + 1, cost};
  }
}

}  // namespace

struct SurfelTree::Range {
  int64_t begin, end;
  Bounds bounds;
  int64_t count() const { return end - begin; }
};

TreeNode SurfelTree::empty_node() {
  TreeNode node;
  for (int child = 0; child < kNodeChildren; ++child) {
    store_bounds(node, child, Bounds());
    node.child[child] = kNoChild;
  }
  return node;
}

void SurfelTree::measure_boxes(const SurfelArrays& surfels, float alpha_cutoff, int threads) {
  RTGS_DISPATCH(surfel_boxes, surfels, alpha_cutoff, boxes_.reserve(surfels.count + 1), threads);
  alpha_cutoff_ = alpha_cutoff;
}

void SurfelTree::split(const Range& range, Range& left, Range& right) {
  int32_t* ids = ids_.data();
  const SurfelBox* boxes = boxes_.get();
  Bounds centres;
  for (int64_t i = range.begin; i < range.end; ++i) {
    const Float4 centre = doubled_centre(boxes[ids[i]]);
    centres.low = min4(centres.low, centre), centres.high = max4(centres.high, centre);
  }
  const Binning binning(centres.low, centres.high, range.count());
  Bounds bounds[3][kMostBins];
  int64_t counts[3][kMostBins] = {};
  for (int64_t i = range.begin; i < range.end; ++i) {
    const SurfelBox& box = boxes[ids[i]];
    const Float4 centre = doubled_centre(box);
    for (int axis = 0; axis < 3; ++axis) {
      const int b = binning.bin(centre, axis);
      bounds[axis][b].add(box);
      ++counts[axis][b];
    }
  }
  Cut cut;
  for (int axis = 0; axis < 3; ++axis)
    if (binning.scale[axis] > 0.f) consider_axis(bounds[axis], counts[axis], binning.bins, axis, cut);
  int64_t middle = (range.begin + range.end) / 2;  // where all centres coincide
  if (cut.axis >= 0)
    middle = std::partition(ids + range.begin, ids + range.end, [&](int32_t id) {
               return binning.bin(doubled_centre(boxes[id]), cut.axis) < cut.first_right_bin;
             }) - ids;
  left = {range.begin, middle, {}};
  right = {middle, range.end, {}};
  for (int64_t i = range.begin; i < range.end; ++i) (i < middle ? left : right).bounds.add(boxes[ids[i]]);
}

int32_t SurfelTree::build_node(const Range& range) {
  const int32_t index = int32_t(nodes_.size());
  nodes_.push_back(empty_node());
  Range parts[kNodeChildren] = {range};
  int count = 1;
  while (count < kNodeChildren) {  // splits the largest part that is too many for a leaf
    int largest = -1;
    float area = 0.f;
    for (int k = 0; k < count; ++k)
      if (parts[k].count() > kMostPerLeaf && (largest < 0 || parts[k].bounds.half_area() > area))  // may be NaN
        largest = k, area = parts[k].bounds.half_area();
    if (largest < 0) break;
    const Range whole = parts[largest];
    split(whole, parts[largest], parts[count++]);
  }
  for (int k = 0; k < count; ++k) {
    const int64_t surfels = parts[k].count();
    const bool leaf = surfels <= kMostPerLeaf;
    const int32_t child = leaf ? leaf_of(int32_t(parts[k].begin), int32_t(surfels)) : build_node(parts[k]);
    store_bounds(nodes_[index], k, parts[k].bounds);
    nodes_[index].child[k] = child;
  }
  return index;
}

void SurfelTree::build(const SurfelArrays& surfels, float alpha_cutoff, int threads) {
  if (surfels.count >= int64_t(1) << 25)
    throw std::invalid_argument("SurfelTree.build: " + std::to_string(surfels.count) + " surfels, at most 2^25 - 1");
  try {
    measure_boxes(surfels, alpha_cutoff, threads);
    ids_.resize(surfels.count);
    build_nodes();
  } catch (...) {  // no memory: half a tree must not be traced
    clear();
    throw;
  }
}

void SurfelTree::build_nodes() {
  Range all = {0, int64_t(ids_.size()), {}};
  for (size_t id = 0; id < ids_.size(); ++id) {
    ids_[id] = int32_t(id);
    all.bounds.add(boxes_.get()[id]);
  }
  nodes_.clear();
  if (ids_.empty()) nodes_.push_back(empty_node());
  else build_node(all);
}

void SurfelTree::clear() {
  ids_.clear();
  nodes_.resize(1);  // there was always one: no memory is asked for
  nodes_[0] = empty_node();
}

void SurfelTree::refit_leaves(TreeNode& node) {
  for (int k = 0; k < kNodeChildren; ++k) {
    const int32_t child = node.child[k];
    if (child >= 0 || child == kNoChild) continue;
    Bounds bounds;
    for (int32_t slot = leaf_first(child), end = slot + leaf_count(child); slot < end; ++slot)
      bounds.add(boxes_.get()[ids_[slot]]);
    store_bounds(node, k, bounds);
  }
}

void SurfelTree::refit_inner(TreeNode& node) {
  for (int k = 0; k < kNodeChildren; ++k) {
    if (node.child[k] < 0) continue;
    Bounds bounds;
    for (int j = 0; j < kNodeChildren; ++j) bounds.add(child_bounds(nodes_[node.child[k]], j));
    store_bounds(node, k, bounds);
  }
}

void SurfelTree::refit(const SurfelArrays& surfels, float alpha_cutoff, int threads) {
  if (surfels.count != this->surfels())
    throw std::invalid_argument("SurfelTree.refit: the tree was built over " + std::to_string(this->surfels()) +
                                " surfels, got " + std::to_string(surfels.count) + "; build it anew");
  measure_boxes(surfels, alpha_cutoff, threads);
  const int64_t count = nodes();
  baseline::each_in_shares(threads, count, [&](int64_t i) { refit_leaves(nodes_[i]); });
  for (int64_t i = count - 1; i >= 0; --i) refit_inner(nodes_[i]);
}

double SurfelTree::surface_cost() const {
  double cost = 0.0;
  Bounds root;
  for (int k = 0; k < kNodeChildren; ++k) root.add(child_bounds(nodes_[0], k));
  if (!(root.half_area() > 0.f)) return 0.0;
  cost += root.half_area() * kNodeChildren;
  for (const TreeNode& node : nodes_)
    for (int k = 0; k < kNodeChildren; ++k) {
      if (node.child[k] == kNoChild) continue;
      const double tests = node.child[k] >= 0 ? kNodeChildren : leaf_count(node.child[k]);
      cost += child_bounds(node, k).half_area() * tests;
    }
  return cost / root.half_area();
}

}  // namespace rtgs
