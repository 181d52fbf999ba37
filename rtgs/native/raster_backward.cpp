// Gradients of a tile, front to back like the forward pass: alpha is recomputed, and besides the transmittance the only
// state is `rest`, the upstream gradient times what the surfels not yet passed add to the pixel. All sums over the
// pixels of one (surfel, tile) stay in registers and are reduced once.
#include "raster_block.h"

namespace rtgs::RTGS_ISA {
namespace {

template <int C>
struct BlockGradients {
  vfloat channels[C], transmittance, rest;
};

struct BlockExtraGradients {  // upstream gradients, and the pixel's totals that the distortion needs
  vfloat depth, median, distortion, total, first_inverse, moment1, moment2;
  vint median_entry;
};

struct ExtraFlags {
  bool depth, median, distortion;
  float depth_scale;  // m = constant - depth_scale / z, the constant of the forward pass
  explicit ExtraFlags(const BackwardArgs& a)
      : depth(a.grad_depth != nullptr), median(a.grad_median != nullptr), distortion(a.grad_distortion != nullptr),
        depth_scale(a.forward.camera.far * a.forward.camera.near / (a.forward.camera.far - a.forward.camera.near)) {}
};

// dL/dw and dL/dz that a contribution at depth z gets from depth, median depth and distortion.
struct DepthGradients {
  vfloat to_weight, to_depth;
};
inline DepthGradients depth_gradients(const ExtraFlags& flags, const BlockExtraGradients& g, vfloat z, vfloat w,
                                      int entry) {
  DepthGradients out = {broadcast(0.f), broadcast(0.f)};
  if (flags.depth) {
    out.to_weight = g.depth * z;
    out.to_depth = w * g.depth;
  }
  if (flags.distortion) {
    const vfloat inverse_z = reciprocal(z), m = flags.depth_scale * (g.first_inverse - inverse_z);
    out.to_weight += g.distortion * (m * (m * g.total - 2.f * g.moment1) + g.moment2);
    const vfloat to_m = 2.f * w * g.distortion * (m * g.total - g.moment1);
    out.to_depth += to_m * (flags.depth_scale * inverse_z * inverse_z);
  }
  if (flags.median) out.to_depth += where(eq_int(g.median_entry, broadcast_int(entry)), g.median);
  return out;
}

struct Range {  // of tiles, that one thread takes
  int first_tile;
  int64_t waiting;  // where the next row that must wait goes
};

// Does the surfel's row belong to an earlier range?
inline bool before_range(const ForwardArgs& forward, int64_t id, int first_tile) {
  if (first_tile == 0) return false;
  const TileRect rect = forward.surfels.rects[id];
  return int64_t(rect.y0) * forward.camera.tiles_x() + rect.x0 < first_tile;
}

template <int C, bool kExtras>
struct TileBackward {
  static constexpr int kSums = kGradChannels + C + (kExtras ? 2 : 0);
  static constexpr int kPaddedSums = (kSums + kLanes - 1) / kLanes * kLanes;
  BlockGradients<C> blocks[kBlocks];
  BlockExtraGradients extras[kExtras ? kBlocks : 1];

  void load_state(const BackwardArgs& args, const Tile& tile);
  void run(const BackwardArgs& args, const Tile& tile, Range& range);
};

template <int C, bool kExtras>
void TileBackward<C, kExtras>::load_state(const BackwardArgs& args, const Tile& tile) {
  const ForwardArgs& forward = args.forward;
  const RasterCamera& camera = forward.camera;
  vmask all_finite = first_lanes(kLanes);
  for (int block = 0; block < kBlocks; ++block) {
    BlockGradients<C>& state = blocks[block];
    const int x = tile.tile_x * kTileSide + int(block_x(block)), y = tile.tile_y * kTileSide + int(block_y(block));
    for (vfloat& v : state.channels) v = broadcast(0.f);
    state.transmittance = broadcast(1.f);
    state.rest = broadcast(0.f);
    if (x >= camera.width || y >= camera.height) continue;  // no entry's mask names such a block
    for (int k = 0; k < forward.surfels.layout.channels; ++k) {
      const float* upstream = args.upstream(k);
      if (!upstream) continue;
      state.channels[k] = load_block(upstream, camera, x, y);
      all_finite = all_finite & finite(state.channels[k]);
      state.rest += state.channels[k] * load_block(forward.plane(k), camera, x, y);
    }
    vfloat final_transmittance = load_block(forward.transmittance, camera, x, y);
    if (args.grad_alpha) {
      const vfloat to_alpha = load_block(args.grad_alpha, camera, x, y);
      all_finite = all_finite & finite(to_alpha);
      state.rest -= to_alpha * final_transmittance;
    }
    if constexpr (kExtras) {
      BlockExtraGradients& extra = extras[block];
      if (args.grad_depth) {
        extra.depth = load_block(args.grad_depth, camera, x, y);
        state.rest += extra.depth * load_block(forward.depth, camera, x, y);
      }
      if (args.grad_distortion) {
        extra.distortion = load_block(args.grad_distortion, camera, x, y);
        state.rest += 2.f * extra.distortion * load_block(forward.distortion, camera, x, y);
        extra.total = 1.f - final_transmittance;
        extra.first_inverse = load_block(forward.first_inverse, camera, x, y);
        extra.moment1 = load_block(forward.moment1, camera, x, y);
        extra.moment2 = load_block(forward.moment2, camera, x, y);
      }
      if (args.grad_median) {
        extra.median = load_block(args.grad_median, camera, x, y);
        extra.median_entry = (vint)load_block(reinterpret_cast<const float*>(forward.median_entry), camera, x, y);
      }
      all_finite = all_finite & finite(extra.depth) & finite(extra.distortion) & finite(extra.median);
    }
  }
  if (any(mask_not(all_finite))) __atomic_store_n(args.poisoned, 1, __ATOMIC_RELAXED);
}

// Adds the gradient sums of one surfel in one block to `sums` (order of GradientField).
template <int C, bool kExtras>
inline __attribute__((always_inline)) void add_block(const ExtraFlags& flags, const float* record, int entry, vfloat x,
                                                     vfloat y, BlockGradients<C>& state,
                                                     const BlockExtraGradients& extra, vfloat* sums) {
  const Response r = respond(record, x, y);
  const vfloat transmittance = state.transmittance;
  const vmask shown = shows(r, transmittance);
  const vfloat raw = exp2_response(r.exponent), alpha = min(raw, broadcast(kMaxAlpha));
  const vfloat w = where(shown, alpha * transmittance);
  vfloat to_weight = state.channels[0] * record[kChannels];
#pragma GCC unroll 36
  for (int k = 1; k < C; ++k) to_weight += state.channels[k] * record[kChannels + k];
  vfloat plane_depth, disc_depth;  // dL/dz of the hit, dL/dz of the centre
  if constexpr (kExtras) {
    const float* depths = record + kChannels + C;
    const DepthGradients g =
        depth_gradients(flags, extra, select(r.plane, depths[0] * r.inverse, broadcast(depths[1])), w, entry);
    to_weight += g.to_weight;
    plane_depth = where(r.plane, g.to_depth);
    disc_depth = g.to_depth - plane_depth;
  }
  const vfloat rest = state.rest - w * to_weight;
  state.rest = rest;
  state.transmittance = transmittance - w;
  // dL/d ln(alpha_raw); nothing where the clamp binds
  const vfloat log_alpha = where(shown & lt(raw, broadcast(kMaxAlpha)),
                                 (transmittance * to_weight - rest * reciprocal(1.f - alpha)) * alpha);
  const vfloat plane = where(r.plane, log_alpha), disc = log_alpha - plane;
  const vfloat q = plane * r.inverse;
  const vfloat to_u = q * r.u, to_v = q * r.v;
  vfloat to_d = q * r.rho;
  if constexpr (kExtras) {
    const vfloat to_inverse = plane_depth * r.inverse;
    to_d -= to_inverse * (record[kChannels + C] * r.inverse);
    sums[kGradChannels + C] += to_inverse;
    sums[kGradChannels + C + 1] += disc_depth;
  }
  sums[kGradLogAlpha] += log_alpha;
  sums[kGradU] += to_u;
  sums[kGradV] += to_v;
  sums[kGradD] += to_d;
  sums[kGradUx] += to_u * r.dx;
  sums[kGradUy] += to_u * r.dy;
  sums[kGradVx] += to_v * r.dx;
  sums[kGradVy] += to_v * r.dy;
  sums[kGradDx] += to_d * r.dx;
  sums[kGradDy] += to_d * r.dy;
  sums[kGradDiscX] += disc * r.dx;
  sums[kGradDiscY] += disc * r.dy;
#pragma GCC unroll 36
  for (int k = 0; k < C; ++k) sums[kGradChannels + k] += w * state.channels[k];
}

template <int C, bool kExtras>
void TileBackward<C, kExtras>::run(const BackwardArgs& args, const Tile& tile, Range& range) {
  constexpr int kFloats = kChannels + C + (kExtras ? kDepthFields : 0);
  const ForwardArgs& forward = args.forward;
  const LaneOffsets offsets;
  const ExtraFlags flags(args);
  const int64_t start = forward.tiles.starts[tile.index], count = forward.tiles.used[tile.index];
  const int32_t* ids = forward.tiles.ids + start;
  const uint64_t* masks = forward.tiles.masks + start;
  const float* records = forward.surfels.records;
  const RecordLayout& layout = forward.surfels.layout;
  for (int64_t entry = 0; entry < count; ++entry) {
    if (entry + kPrefetchDistance < count) {
      const int64_t ahead = ids[entry + kPrefetchDistance];
      prefetch_row<kFloats>(records + layout.record_stride * ahead);
      prefetch_row<kPaddedSums, 1>(args.rows + layout.gradient_stride * ahead);
    }
    uint64_t remaining = masks[entry];
    if (!remaining) continue;
    const int64_t id = ids[entry];
    const float* record = records + layout.record_stride * id;
    vfloat sums[kPaddedSums];
#pragma GCC unroll 64
    for (int k = 0; k < kPaddedSums; ++k) sums[k] = broadcast(0.f);
    while (remaining) {
      const int block = __builtin_ctzll(remaining);
      remaining &= remaining - 1;
      add_block<C, kExtras>(flags, record, int(entry), offsets.x + (tile.x + block_x(block)),
                            offsets.y + (tile.y + block_y(block)), blocks[block], extras[kExtras ? block : 0], sums);
    }
    float* row = args.rows + layout.gradient_stride * id;
    const bool waits = before_range(forward, id, range.first_tile);
    if (waits) {
      args.waiting_ids[range.waiting] = int32_t(id);
      row = args.waiting_rows + layout.gradient_stride * range.waiting++;
    }
#pragma GCC unroll 16
    for (int k = 0; k < kPaddedSums; k += kLanes) {
      const vfloat total = settled(sums_of<>(sums + k));
      store(row + k, waits ? total : load(row + k) + total);
    }
  }
}

// Ranges of about equal work: range_starts.
void split_work(const BackwardArgs& args) {
  const TileLists& lists = args.forward.tiles;
  const int tiles = args.forward.camera.tiles_x() * args.forward.camera.tiles_y(), threads = args.forward.threads;
  int64_t total = 0, done = 0;
  for (int tile = 0; tile < tiles; ++tile) total += lists.work[tile];
  int range = 0;
  for (int tile = 0; tile < tiles; ++tile) {
    while (range < threads && done * threads >= total * range) args.range_starts[range++] = tile;
    done += lists.work[tile];
  }
  while (range <= threads) args.range_starts[range++] = tiles;
}

template <int C, bool kExtras>
void backward_tiles(const BackwardArgs& args) {
  const int threads = args.forward.threads;
  split_work(args);
#pragma omp parallel for num_threads(threads) schedule(static, 1) if (threads > 1)
  for (int part = 0; part < threads; ++part) {
    alignas(64) TileBackward<C, kExtras> state;
    if (kExtras) memset(static_cast<void*>(state.extras), 0, sizeof state.extras);
    const int begin = int(args.range_starts[part]), end = int(args.range_starts[part + 1]);
    const int64_t first_waiting = args.forward.tiles.starts[begin];
    Range range = {begin, first_waiting};
    for (int index = begin; index < end; ++index) {
      if (!args.forward.tiles.used[index]) continue;
      const Tile tile(args.forward.camera, index);
      state.load_state(args, tile);
      state.run(args, tile, range);
    }
    args.waiting_counts[part] = range.waiting - first_waiting;
  }
}

// Each thread takes a share of the surfels, so that the order of additions to a row is that of the tiles.
void add_waiting(const BackwardArgs& args, int64_t count) {
  const int threads = args.forward.threads;
  const RecordLayout& layout = args.forward.surfels.layout;
#pragma omp parallel for num_threads(threads) schedule(static, 1)
  for (int part = 0; part < threads; ++part) {
    const int64_t begin = count * part / threads, end = count * (part + 1) / threads;
    for (int range = 1; range < threads; ++range) {
      const int64_t first = args.forward.tiles.starts[args.range_starts[range]];
      for (int64_t k = first; k < first + args.waiting_counts[range]; ++k) {
        const int64_t id = args.waiting_ids[k];
        if (id < begin || id >= end) continue;
        const float* from = args.waiting_rows + layout.gradient_stride * k;
        float* row = args.rows + layout.gradient_stride * id;
        for (int j = 0; j < layout.gradient_sums(); j += kLanes) store(row + j, load(row + j) + load(from + j));
      }
    }
  }
}

template <int C>
struct Backward {
  static void run(const BackwardArgs& args) {
    if (args.forward.surfels.layout.depth) backward_tiles<C, true>(args);
    else backward_tiles<C, false>(args);
  }
};

}  // namespace

void raster_backward(const BackwardArgs& args, int64_t count) {
  for_channels<Backward>(args.forward.surfels.layout.padded_channels, args);
  if (args.forward.threads > 1) add_waiting(args, count);
}

}  // namespace rtgs::RTGS_ISA
