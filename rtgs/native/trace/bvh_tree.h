// Builder and owner of the hierarchy; ordinary C++ for the baseline instruction set.
#pragma once
#include <vector>

#include "trace/bvh.h"
#include "raster/state.h"

namespace rtgs {

class SurfelTree {
 public:
  SurfelTree() { nodes_.push_back(empty_node()); }

  void build(const SurfelArrays& surfels, float alpha_cutoff, int threads);
  // New boxes for the old topology; the surfel count must not have changed.
  void refit(const SurfelArrays& surfels, float alpha_cutoff, int threads);

  TreeView view() const { return {nodes_.data(), ids_.data(), int64_t(ids_.size())}; }
  int64_t nodes() const { return int64_t(nodes_.size()); }
  int64_t surfels() const { return int64_t(ids_.size()); }
  float alpha_cutoff() const { return alpha_cutoff_; }
  // Surface area heuristic relative to the root: expected box tests and surfel tests of a ray that meets the root.
  double surface_cost() const;

 private:
  struct Range;
  static TreeNode empty_node();
  void clear();
  void build_nodes();
  int32_t build_node(const Range& range);
  void split(const Range& range, Range& left, Range& right);
  void measure_boxes(const SurfelArrays& surfels, float alpha_cutoff, int threads);
  void refit_leaves(TreeNode& node);
  void refit_inner(TreeNode& node);

  std::vector<TreeNode> nodes_;  // parents before their children
  std::vector<int32_t> ids_;                              // slot -> row
  Buffer<SurfelBox> boxes_;                               // by row
  float alpha_cutoff_ = 0.f;
};

}  // namespace rtgs
