// Gradients of a tile, front to back like the forward pass: alpha is recomputed, and besides the transmittance the only
// state is `rest`, the upstream gradient times what the Gaussians not yet passed add to the pixel. All sums over the
// pixels of one (Gaussian, tile) stay in registers and are reduced once.
#pragma once
#include "common/parallel.h"
#include "raster/block.h"

namespace rtgs::RTGS_ISA {

template <int C>
struct BlockGradients {
  vfloat channels[C], transmittance, rest;
};

struct Range {  // of tiles, that one thread takes
  int first_tile;
  int64_t waiting;  // where the next row that must wait goes
};

// Does the Gaussian's row belong to an earlier range?
static inline bool before_range(const ForwardArgs& forward, int64_t id, int first_tile) {
  if (first_tile == 0) return false;
  const TileRect rect = forward.gaussians.rects[id];
  return int64_t(rect.y0) * forward.camera.tiles_x() + rect.x0 < first_tile;
}

template <class Footprint, int C, bool kExtras, bool kAbsolute>
struct TileBackward {
  static constexpr int kExtraSums = (kExtras ? Footprint::kExtraSums : 0) + (kAbsolute ? 2 : 0);
  static constexpr int kSums = Footprint::kGradChannels + C + kExtraSums;
  static constexpr int kPaddedSums = (kSums + kLanes - 1) / kLanes * kLanes;
  BlockGradients<C> blocks[kBlocks];
  typename Footprint::ExtraUpstream extras[kExtras ? kBlocks : 1];

  void load_state(const BackwardArgs& args, const Tile& tile);
  void run(const BackwardArgs& args, const Tile& tile, Range& range);
};

template <class Footprint, int C, bool kExtras, bool kAbsolute>
void TileBackward<Footprint, C, kExtras, kAbsolute>::load_state(const BackwardArgs& args, const Tile& tile) {
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
    for (int k = 0; k < forward.gaussians.layout.channels; ++k) {
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
    if constexpr (kExtras)
      Footprint::load_extras(args, x, y, final_transmittance, extras[block], state.rest, all_finite);
  }
  if (any(mask_not(all_finite))) __atomic_store_n(args.poisoned, 1, __ATOMIC_RELAXED);
}

// Adds the gradient sums of one Gaussian in one block to `sums`: the footprint's, then those of the channels.
template <class Footprint, int C, bool kExtras, bool kAbsolute>
static inline __attribute__((always_inline)) void add_block(const typename Footprint::BackwardFlags& flags,
                                                            const typename Footprint::Entry& gaussian, const float* record,
                                                            int entry, int block, vfloat least_transmittance,
                                                            BlockGradients<C>& state,
                                                            const typename Footprint::ExtraUpstream& extra, vfloat* sums) {
  constexpr int kChannels = Footprint::kChannels, kGradChannels = Footprint::kGradChannels;
  const typename Footprint::Response r = gaussian.respond(block);
  const vfloat transmittance = state.transmittance;
  const vmask shown = shows(r.exponent, gaussian.least_exponent(), transmittance, least_transmittance);
  const vfloat raw = exp2_response(r.exponent), alpha = min(raw, broadcast(kMaxAlpha));
  const vfloat w = where(shown, alpha * transmittance);
  vfloat to_weight = state.channels[0] * record[kChannels];
#pragma GCC unroll 36
  for (int k = 1; k < C; ++k) to_weight += state.channels[k] * record[kChannels + k];
  typename Footprint::ExtraGradients to_extra;
  if constexpr (kExtras) {
    to_extra = Footprint::extra_gradients(flags, extra, r, record + kChannels + C, w, entry);
    to_weight += to_extra.to_weight;
  }
  const vfloat rest = state.rest - w * to_weight;
  state.rest = rest;
  state.transmittance = transmittance - w;
  // dL/d ln(alpha_raw); nothing where the clamp binds
  const vfloat log_alpha = where(shown & lt(raw, broadcast(kMaxAlpha)),
                                 (transmittance * to_weight - rest * reciprocal(1.f - alpha)) * alpha);
  Footprint::template add_gradients<C, kExtras>(record, r, log_alpha, to_extra, sums);
  constexpr int kAfter = kGradChannels + C + (kExtras ? Footprint::kExtraSums : 0);
  if constexpr (kAbsolute) Footprint::add_absolute(flags, record, r, log_alpha, sums + kAfter);
#pragma GCC unroll 36
  for (int k = 0; k < C; ++k) sums[kGradChannels + k] += w * state.channels[k];
}

template <class Footprint, int C, bool kExtras, bool kAbsolute>
void TileBackward<Footprint, C, kExtras, kAbsolute>::run(const BackwardArgs& args, const Tile& tile, Range& range) {
  constexpr int kFloats = Footprint::kChannels + C + (kExtras ? Footprint::kExtraFields : 0);
  const ForwardArgs& forward = args.forward;
  const LaneOffsets offsets;
  const typename Footprint::BackwardFlags flags(args);
  const vfloat least_transmittance = broadcast(forward.camera.min_transmittance);
  const int64_t start = forward.tiles.starts[tile.index], count = forward.tiles.used[tile.index];
  const int32_t* ids = forward.tiles.ids + start;
  const uint64_t* masks = forward.tiles.masks + start;
  const float* records = forward.gaussians.records;
  const RecordLayout& layout = forward.gaussians.layout;
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
    typename Footprint::Entry gaussian(record, tile, offsets, forward);
    gaussian.prepare();
    vfloat sums[kPaddedSums];
#pragma GCC unroll 64
    for (int k = 0; k < kPaddedSums; ++k) sums[k] = broadcast(0.f);
    while (remaining) {
      const int block = __builtin_ctzll(remaining);
      remaining &= remaining - 1;
      add_block<Footprint, C, kExtras, kAbsolute>(flags, gaussian, record, int(entry), block, least_transmittance,
                                                  blocks[block], extras[kExtras ? block : 0], sums);
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

template <class Footprint, int C, bool kExtras, bool kAbsolute>
void backward_tiles(const BackwardArgs& args) {
  const int threads = args.forward.threads;
  split_work(args);
  in_parts(threads, [&](int part) {
    alignas(64) TileBackward<Footprint, C, kExtras, kAbsolute> state;
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
  });
}

template <class Footprint, int C, bool kExtras>
void backward_by_signal(const BackwardArgs& args) {
  if (args.forward.gaussians.layout.absolute) backward_tiles<Footprint, C, kExtras, true>(args);
  else backward_tiles<Footprint, C, kExtras, false>(args);
}

template <class Footprint, int C>
void backward_of(const BackwardArgs& args) {
  if (Footprint::has_extras(args)) backward_by_signal<Footprint, C, true>(args);
  else backward_by_signal<Footprint, C, false>(args);
}

}  // namespace rtgs::RTGS_ISA
