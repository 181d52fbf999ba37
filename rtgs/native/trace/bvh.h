// The bounding volume hierarchy over surfels (docs/tracer.md): 8 children a node, leaves of up to 48 surfels.
#pragma once
#include <cstdint>

#include "raster/raster.h"

namespace rtgs {

constexpr int kNodeChildren = 8;
constexpr int kMostPerLeaf = 48;
constexpr int kSlotsPerBlock = 8;  // whose boxes are tested at once
static_assert(kMostPerLeaf + kSlotsPerBlock - 1 <= 64, "a bit for each surfel of a leaf and of the blocks it lies in");
constexpr int32_t kNoChild = INT32_MIN;

struct alignas(64) TreeNode {
  float low[3][kNodeChildren], high[3][kNodeChildren];  // low > high: nothing in it that a ray can hit
  int32_t child[kNodeChildren];                         // >= 0: node; kNoChild; else ~(64 * first slot + count)
};
static inline int32_t leaf_of(int32_t first, int32_t count) { return ~(64 * first + count); }
static inline int32_t leaf_first(int32_t child) { return ~child >> 6; }
static inline int32_t leaf_count(int32_t child) { return ~child & 63; }

struct SurfelBox {  // components 0..2 count
  alignas(16) float low[4];
  alignas(16) float high[4];
};

struct alignas(64) SlotBoxes {  // of a block of slots; those of the surfels that are never hit hold nothing
  float low[3][kSlotsPerBlock], high[3][kSlotsPerBlock];
};

struct TreeView {  // what the kernels see; surfels in the order of the leaves are called slots
  const TreeNode* nodes;  // the root first; at least one
  const int32_t* ids;     // (surfels) row of each slot
  int64_t surfels;
};

#define RTGS_BVH_KERNELS(isa)                                                                                      \
  namespace isa {                                                                                                  \
  /* Boxes of the part of each surfel where alpha reaches the cut; what is never hit gets an empty one. */         \
  void surfel_boxes(const SurfelArrays&, float alpha_cutoff, SurfelBox* boxes, int threads);                       \
  }
RTGS_BVH_KERNELS(portable)
#if defined(__x86_64__)
RTGS_BVH_KERNELS(avx2)
RTGS_BVH_KERNELS(avx512)
#endif
#undef RTGS_BVH_KERNELS

}  // namespace rtgs
