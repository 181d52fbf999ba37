// How a surfel answers in a tile, forward and backward: the footprint of the loops in forward.h, backward.h.
#pragma once
#include "raster/block.h"
#include "raster/surfels.h"

namespace rtgs::RTGS_ISA {

struct SurfelFootprint {
  static constexpr int kChannels = rtgs::kChannels, kGradChannels = rtgs::kGradChannels;
  static constexpr int kExtraFields = kDepthFields, kExtraSums = 2;

  struct Response {
    vfloat dx, dy, inverse, u, v, rho, exponent;  // inverse = 1/D; u, v in standard deviations; alpha_raw = 2^exponent
    vmask plane;                                  // the plane branch; elsewhere inverse, u, v are finite, no more
  };

  // One surfel in one tile.
  class Entry {
   public:
    Entry(const float* record, const Tile& tile, const LaneOffsets& offsets, const ForwardArgs& args)
        : record_(record), tile_(tile), offsets_(offsets), least_exponent_(args.camera.log2_min_alpha),
          low_pass_(args.camera.low_pass) {}

    // Which blocks of the tile meet the surfel's bound ellipse or its low-pass disc.
    uint64_t touched() const {
      const vfloat zero = broadcast(0.f);
      uint64_t touched = 0;
#pragma GCC unroll 16
      for (int group = 0; group < kBlocks; group += kLanes) {
        const BlockCorners corners(tile_, group);
        vfloat least = least_in_block(record_ + kBound, corners.x - record_[kBoundX], corners.y - record_[kBoundY]);
        vfloat dx = corners.x - record_[kMeanX], dy = corners.y - record_[kMeanY];
        dx = min(max(zero, dx), dx + kBlockReachX);
        dy = min(max(zero, dy), dy + kBlockReachY);
        vmask hit = ge(broadcast(1.f), least) | ge(broadcast(record_[kDisc2]), dx * dx + dy * dy);
        touched |= uint64_t(mask_bits(hit)) << group;
      }
      return touched;
    }
    void prepare() {}

    Response respond(int block) const {
      Response r;
      r.dx = offsets_.x + (tile_.x + block_x(block)) - record_[kMeanX];
      r.dy = offsets_.y + (tile_.y + block_y(block)) - record_[kMeanY];
      vfloat d = record_[kDx] * r.dx + (record_[kDy] * r.dy + record_[kD0]);
      r.inverse = reciprocal(max(d, broadcast(1e-18f)));  // D <= 0 never counts: rho_plane overflows, the disc wins
      r.u = (record_[kUx] * r.dx + record_[kUy] * r.dy) * r.inverse;
      r.v = (record_[kVx] * r.dx + record_[kVy] * r.dy) * r.inverse;
      vfloat rho_plane = r.u * r.u + r.v * r.v, rho_disc = low_pass_ * (r.dx * r.dx + r.dy * r.dy);
      r.plane = lt(rho_plane, rho_disc) & ge(r.inverse, broadcast(record_[kMinInverse]));
      r.rho = select(r.plane, rho_plane, rho_disc);
      r.exponent = record_[kLogOpacity] - kHalfLog2E * r.rho;
      return r;
    }
    vfloat least_exponent() const { return broadcast(least_exponent_); }

   private:
    const float* record_;
    const Tile& tile_;
    const LaneOffsets& offsets_;
    float least_exponent_, low_pass_;
  };

  // ---- forward: the optional outputs ---------------------------------------------------------------------------
  struct Extras {
    vfloat depth, median_depth, distortion, moment1, moment2, first_inverse;  // first_inverse: 1/z_0, see add_extras
    vint median_entry;
    void clear() {
      depth = median_depth = distortion = moment1 = moment2 = first_inverse = broadcast(0.f);
      median_entry = broadcast_int(-1);
    }
  };
  struct ForwardFlags {
    bool depth, median, distortion;
    float depth_scale;  // m = constant - depth_scale / z
    bool any() const { return depth || median || distortion; }
    explicit ForwardFlags(const ForwardArgs& a)
        : depth(a.depth != nullptr), median(a.median_depth != nullptr), distortion(a.distortion != nullptr),
          depth_scale(a.camera.far * a.camera.near / (a.camera.far - a.camera.near)) {}
  };
  static bool wants_extras(const ForwardArgs& a) { return a.depth || a.median_depth || a.distortion || a.entry_weights; }

  static inline void add_extras(const ForwardFlags& flags, const Response& r, const float* depths, vfloat w, vmask shown,
                                vfloat transmittance, int entry, Extras& extras) {
    const vfloat z = select(r.plane, depths[0] * r.inverse, broadcast(depths[1]));
    if (flags.depth) extras.depth += w * z;
    if (flags.median) {
      vmask before_half = shown & gt(transmittance, broadcast(0.5f));
      extras.median_depth = select(before_half, z, extras.median_depth);
      extras.median_entry = select_int(before_half, broadcast_int(entry), extras.median_entry);
    }
    if (flags.distortion) {
      // Only differences of m count: take the first contribution's from all, or the sums cancel.
      const vfloat inverse_z = reciprocal(z);
      extras.first_inverse = select(shown & ge(broadcast(0.f), extras.first_inverse), inverse_z, extras.first_inverse);
      const vfloat m = flags.depth_scale * (extras.first_inverse - inverse_z), wm = w * m;
      extras.distortion += w * (m * m * (1.f - transmittance) + extras.moment2 - 2.f * m * extras.moment1);
      extras.moment1 += wm;
      extras.moment2 += wm * m;
    }
  }

  static inline void write_extras(const ForwardArgs& args, int x, int y, const Extras& extra) {
    const RasterCamera& camera = args.camera;
    if (args.depth) store_block(args.depth, camera, x, y, extra.depth);
    if (args.median_depth) {
      store_block(args.median_depth, camera, x, y, extra.median_depth);
      store_block(reinterpret_cast<float*>(args.median_entry), camera, x, y, (vfloat)extra.median_entry);
    }
    if (args.distortion) {
      store_block(args.distortion, camera, x, y, extra.distortion);
      store_block(args.first_inverse, camera, x, y, extra.first_inverse);
      store_block(args.moment1, camera, x, y, extra.moment1);
      store_block(args.moment2, camera, x, y, extra.moment2);
    }
  }

  // ---- backward ------------------------------------------------------------------------------------------------
  struct ExtraUpstream {  // upstream gradients, and the pixel's totals that the distortion needs
    vfloat depth, median, distortion, total, first_inverse, moment1, moment2;
    vint median_entry;
  };
  struct BackwardFlags {
    bool depth, median, distortion;
    float depth_scale;  // m = constant - depth_scale / z, the constant of the forward pass
    float low_pass;
    explicit BackwardFlags(const BackwardArgs& a)
        : depth(a.grad_depth != nullptr), median(a.grad_median != nullptr), distortion(a.grad_distortion != nullptr),
          depth_scale(a.forward.camera.far * a.forward.camera.near / (a.forward.camera.far - a.forward.camera.near)),
          low_pass(a.forward.camera.low_pass) {}
  };
  static bool has_extras(const BackwardArgs& a) { return a.forward.gaussians.layout.depth; }

  // Adds to `rest`, and to `all_finite` what is not.
  static inline void load_extras(const BackwardArgs& args, int x, int y, vfloat final_transmittance, ExtraUpstream& extra,
                                 vfloat& rest, vmask& all_finite) {
    const ForwardArgs& forward = args.forward;
    const RasterCamera& camera = forward.camera;
    if (args.grad_depth) {
      extra.depth = load_block(args.grad_depth, camera, x, y);
      rest += extra.depth * load_block(forward.depth, camera, x, y);
    }
    if (args.grad_distortion) {
      extra.distortion = load_block(args.grad_distortion, camera, x, y);
      rest += 2.f * extra.distortion * load_block(forward.distortion, camera, x, y);
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

  // dL/dw and dL/dz that a contribution gets from depth, median depth and distortion.
  struct ExtraGradients {
    vfloat to_weight, to_depth;
  };
  static inline ExtraGradients extra_gradients(const BackwardFlags& flags, const ExtraUpstream& g, const Response& r,
                                               const float* depths, vfloat w, int entry) {
    const vfloat z = select(r.plane, depths[0] * r.inverse, broadcast(depths[1]));
    ExtraGradients out = {broadcast(0.f), broadcast(0.f)};
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

  // Adds to the sums of GradientField; log_alpha is dL/d ln(alpha_raw).
  template <int C, bool kExtras>
  static inline __attribute__((always_inline)) void add_gradients(const float* record, const Response& r, vfloat log_alpha,
                                                                  const ExtraGradients& extra, vfloat* sums) {
    const vfloat plane = where(r.plane, log_alpha), disc = log_alpha - plane;
    const vfloat q = plane * r.inverse;
    const vfloat to_u = q * r.u, to_v = q * r.v;
    vfloat to_d = q * r.rho;
    if constexpr (kExtras) {
      const vfloat plane_depth = where(r.plane, extra.to_depth);  // dL/dz of the hit; the rest is the centre's
      const vfloat to_inverse = plane_depth * r.inverse;
      to_d -= to_inverse * (record[kChannels + C] * r.inverse);
      sums[kGradChannels + C] += to_inverse;
      sums[kGradChannels + C + 1] += extra.to_depth - plane_depth;
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
  }

  // Adds |dL/dm|, with m the projected centre, to two sums: of what the surfel weighs, its depth left out.
  static inline __attribute__((always_inline)) void add_absolute(const BackwardFlags& flags, const float* record,
                                                                 const Response& r, vfloat log_alpha, vfloat* sums) {
    const vfloat plane = where(r.plane, log_alpha), disc = flags.low_pass * (log_alpha - plane);
    const vfloat q = plane * r.inverse;
    const vfloat to_u = q * r.u, to_v = q * r.v, to_d = q * r.rho;
    sums[0] += abs(record[kUx] * to_u + record[kVx] * to_v - record[kDx] * to_d + disc * r.dx);
    sums[1] += abs(record[kUy] * to_u + record[kVy] * to_v - record[kDy] * to_d + disc * r.dy);
  }
};

}  // namespace rtgs::RTGS_ISA
