// The surfel tracer (docs/tracer.md): what its kernels share with their binding. Plain structs, no ownership.
#pragma once
#include <cstdint>

#include "trace/bvh.h"
#include "raster/raster.h"

namespace rtgs {

// One record per slot (surfel in the order of the tree's leaves): a cache line with what a ray needs.
enum TraceField : int {
  kTraceMean = 0, kTraceNormal = 3,
  kTraceU = 6, kTraceV = 9,  // tangents divided by their scales
  kTraceReach = 12,          // a hit counts where u^2 + v^2 <= this
  kTraceLogOpacity = 13,     // log2
  kTraceId = 14,             // bits of an int32: the surfel's row
  kTraceFields = 16,
};

// Gradient row of a slot: sums over the rays, before the chain rule of the surfel.
enum TraceGradient : int {
  kTraceGradMean = 0, kTraceGradNormal = 3, kTraceGradU = 6, kTraceGradV = 9,
  kTraceGradLogAlpha = 12,
  kTraceGradProbe = 13,
  kTraceGradChannels = 16,  // features and the three colours, padded; then the coefficients of sh_rest in use
};

struct TraceSurfels {
  SurfelArrays arrays;           // features null: none
  const float *sh_dc, *sh_rest;  // (N, 3), (N, rest, 3) or null
  int rest;                      // coefficients that sh_rest stores, per channel
  int degree;                    // that is evaluated
  int feature_count() const { return arrays.features ? arrays.channels : 0; }
  int colour_count() const { return sh_dc ? 3 : 0; }
};

struct TraceRays {
  int64_t count;
  const float *origins, *directions;  // (R, 3)
  const float *t_min_each, *t_max_each;  // (R) or null: then t_min, t_max
  float t_min, t_max;
  const int32_t* order;  // (R) rays in the order in which packets take them, or null: as they come
};

struct TraceOptionsNative {
  float transmittance_cutoff, alpha_cutoff;
  bool last_sh, raw_sh;
  int threads;
};

struct RayOrderArgs {
  TraceRays rays;
  TreeView tree;
  bool always;          // sort; else only where it seems to pay
  float* coordinates;   // (5, R)
  DepthKey *keys, *spare;  // (R)
  int64_t* scratch;     // order_scratch()
  int32_t* order;       // (R) result
  int threads;
};

// What one packet of rays met; written by the forward pass, in memory of the thread that traced it.
struct PacketTape {
  const int32_t* ids;     // (surfels) ascending, so that no sum depends on the tree
  const int32_t* slots;   // (surfels)
  const int32_t* places;  // (surfels) number by which the rows call it
  const float* weights;   // (surfels) sum of w over the packet's rays
  const void* rows;       // (row_count, lanes) uint16 or, if wide, int32: k-th hits of the lanes; all ones: none
  int32_t surfels, row_count, places_used, hits;
  bool wide;
};

// Memory that grows by blocks and keeps what it holds; one for each thread. The blocks belong to the binding.
struct TapeArena {
  char* free;
  int64_t left;
  void* blocks;
  void (*more)(TapeArena&, int64_t bytes);  // provides at least that many
};

struct TraceForwardArgs {
  TraceSurfels surfels;
  TraceRays rays;
  TraceOptionsNative options;
  TreeView tree;
  const float* records;   // (N, kTraceFields)
  const SlotBoxes* boxes;  // (N / 8 + 1)
  PacketTape* tapes;      // (packets), or null where neither a backward pass nor the weights are wanted
  TapeArena* arenas;      // (threads)
  void** workspaces;      // (threads) made on first use, see free_trace_workspace
  // outputs, null when not wanted
  float *colors, *features, *alpha, *depth, *normal;
  int64_t hits;           // result
};

// Where a group of packets has its gradient rows: in which thread's workspace, and which of them.
struct TraceGroup {
  int part;
  int64_t begin, end;
};

struct TraceBackwardArgs {
  TraceSurfels surfels;
  TraceRays rays;
  TraceOptionsNative options;
  const float* records;
  const PacketTape* tapes;
  void** workspaces;
  const float *colors, *features, *alpha, *depth, *normal;                                // what forward wrote
  const float *grad_colors, *grad_features, *grad_alpha, *grad_depth, *grad_normal;       // upstream; null: none
  float* rows;            // (N, row_stride); valid where touched
  uint8_t* touched;       // (N) zero before the call
  int row_stride, first_coefficient;  // floats; where in a row the gradients of sh_rest begin
  bool surfel_gradients, ray_gradients;  // what is wanted: rows; out_origins and out_directions
  float *out_origins, *out_directions;
  int* poisoned;          // set to 1 when an upstream gradient is NaN or infinite
  // Packets come in groups, whose sums are added in their order: so no bit depends on the number of threads.
  TraceGroup* groups;     // those that are summed and not yet added; no more than there are packets
};

struct TraceGradients {  // null: not wanted
  float *means, *tangent_u, *tangent_v, *scales, *opacities, *features, *sh_dc, *sh_rest, *probe;
  bool any() const {
    return means || tangent_u || tangent_v || scales || opacities || features || sh_dc || sh_rest || probe;
  }
};

#define RTGS_TRACE_KERNELS(isa)                                                                                       \
  namespace isa {                                                                                                     \
  int packet_lanes();                                                                                                 \
  int trace_row_stride(const TraceSurfels&);                                                                          \
  int first_coefficient(const TraceSurfels&);                                                                         \
  void trace_records(const SurfelArrays&, const TreeView&, float alpha_cutoff, float* records, SlotBoxes* boxes,      \
                     int32_t* slots, int threads);                                                                    \
  bool order_rays(const RayOrderArgs&);                                                                               \
  int64_t order_scratch();                                                                                            \
  void trace_forward(TraceForwardArgs&);                                                                              \
  void sum_packet_weights(const TraceForwardArgs&, float* weight_sum);                                                \
  void trace_backward(const TraceBackwardArgs&);                                                                      \
  void trace_surfel_gradients(const TraceBackwardArgs&, const int32_t* slots, const TraceGradients&, bool saturate);  \
  void free_trace_workspace(void*);                                                                                   \
  }
RTGS_TRACE_KERNELS(portable)
#if defined(__x86_64__)
RTGS_TRACE_KERNELS(avx2)
RTGS_TRACE_KERNELS(avx512)
#endif
#undef RTGS_TRACE_KERNELS

}  // namespace rtgs
