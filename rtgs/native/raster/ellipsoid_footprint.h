// How an ellipsoid answers in a tile, forward and backward: the footprint of the loops in forward.h and
// backward.h. w is affine in the pixel: what depends on the lane is computed once per (ellipsoid, tile), what
// depends on the block for all blocks at once.
#pragma once
#include "raster/block.h"
#include "raster/ellipsoids.h"

namespace rtgs::RTGS_ISA {

struct EllipsoidFootprint {
  using Record = EllipsoidRecord;
  using Sums = EllipsoidSums;
  static constexpr int kChannels = Record::kChannels, kGradChannels = Sums::kChannels;
  static constexpr int kExtraFields = 0, kExtraSums = 0;

  struct Response {
    vfloat w0, w1, exponent;  // alpha_raw = 2^exponent
  };

  // One ellipsoid in one tile.
  class Entry {
   public:
    Entry(const float* record, const Tile& tile, const LaneOffsets& offsets, const ForwardArgs& args)
        : record_(record), tile_(tile), offsets_(offsets) {
      const float at_radius = record[Record::kLogOpacity] - args.largest_fall;
      const float cut = args.camera.log2_min_alpha;
      least_exponent_ = broadcast(at_radius > cut ? at_radius : cut);
    }

    // Which blocks of the tile meet the bound ellipse.
    uint64_t touched() const {
      uint64_t touched = 0;
#pragma GCC unroll 16
      for (int group = 0; group < kBlocks; group += kLanes) {
        const BlockCorners corners(tile_, group);
        const vfloat least = least_in_block(record_ + Record::kBound, corners.x - record_[Record::kMeanX],
                                            corners.y - record_[Record::kMeanY]);
        touched |= uint64_t(mask_bits(ge(broadcast(1.f), least))) << group;
      }
      return touched;
    }

    void prepare() {
      const float l0 = record_[Record::kL0], l1 = record_[Record::kL1], l2 = record_[Record::kL2];
      const vfloat x = offsets_.x - 0.5f, y = offsets_.y - 0.5f;
      lane_w0_ = l0 * x;
      lane_w1_ = l1 * x + l2 * y;
#pragma GCC unroll 16
      for (int group = 0; group < kBlocks; group += kLanes) {
        const BlockCorners corners(tile_, group);
        const vfloat dx = corners.x - record_[Record::kMeanX], dy = corners.y - record_[Record::kMeanY];
        store(block_w0_ + group, l0 * dx);
        store(block_w1_ + group, l1 * dx + l2 * dy);
      }
    }

    Response respond(int block) const {
      Response r;
      r.w0 = lane_w0_ + block_w0_[block];
      r.w1 = lane_w1_ + block_w1_[block];
      r.exponent = record_[Record::kLogOpacity] - (r.w0 * r.w0 + r.w1 * r.w1);
      return r;
    }
    vfloat least_exponent() const { return least_exponent_; }

   private:
    const float* record_;
    const Tile& tile_;
    const LaneOffsets& offsets_;
    vfloat lane_w0_, lane_w1_, least_exponent_;
    alignas(64) float block_w0_[kBlocks], block_w1_[kBlocks];
  };

  // Depth is a channel, so the weight sum is the only optional output of its own.
  struct Extras {
    void clear() {}
  };
  struct ForwardFlags {
    explicit ForwardFlags(const ForwardArgs&) {}
    bool any() const { return false; }
  };
  static bool wants_extras(const ForwardArgs& a) { return a.entry_weights != nullptr; }
  static inline void add_extras(const ForwardFlags&, const Response&, const float*, vfloat, vmask, vfloat, int, Extras&) {}
  static inline void write_extras(const ForwardArgs&, int, int, const Extras&) {}

  struct ExtraUpstream {};
  struct ExtraGradients {};
  struct BackwardFlags {
    explicit BackwardFlags(const BackwardArgs&) {}
  };

  // Adds to EllipsoidSums; log_alpha is dL/d ln(alpha_raw).
  template <int C, bool kExtras>
  static inline __attribute__((always_inline)) void add_gradients(const float*, const Response& r, vfloat log_alpha,
                                                                  const ExtraGradients&, vfloat* sums) {
    const vfloat to_w0 = log_alpha * r.w0, to_w1 = log_alpha * r.w1;
    sums[Sums::kLogAlpha] += log_alpha;
    sums[Sums::kW0] += to_w0;
    sums[Sums::kW1] += to_w1;
    sums[Sums::kW00] += to_w0 * r.w0;
    sums[Sums::kW01] += to_w0 * r.w1;
    sums[Sums::kW11] += to_w1 * r.w1;
  }

  // Adds |dL/dm| times kHalfLog2E, with m the projected centre, to two sums.
  static inline __attribute__((always_inline)) void add_absolute(const BackwardFlags&, const float* record,
                                                                 const Response& r, vfloat log_alpha, vfloat* sums) {
    const vfloat to_w0 = log_alpha * r.w0, to_w1 = log_alpha * r.w1;
    sums[0] += abs(record[Record::kL0] * to_w0 + record[Record::kL1] * to_w1);
    sums[1] += abs(record[Record::kL2] * to_w1);
  }
};

}  // namespace rtgs::RTGS_ISA
