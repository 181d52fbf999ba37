// The surfels' forward pass, and what forward passes of every kind of Gaussian share.
#include "common/parallel.h"
#include "raster/forward.h"
#include "raster/surfel_footprint.h"

namespace rtgs::RTGS_ISA {

int padded_channels(int channels) {
  const int all[] = {3, 4, 6, 9, 12, 16, 24};
  for (int compiled : all)
    if (channels <= compiled) return compiled;
  return 36;
}

namespace {

template <int C>
struct Forward {
  static void run(const ForwardArgs& args) { forward_of<SurfelFootprint, C>(args); }
};

}  // namespace

void raster_forward(const ForwardArgs& args) { for_channels<Forward>(args.gaussians.layout.padded_channels, args); }

// Adds in the order of entries, each thread for its share of the Gaussians.
void sum_entry_weights(const ForwardArgs& args, int64_t count, float* weight_sum) {
  const int64_t tiles = int64_t(args.camera.tiles_x()) * args.camera.tiles_y(), entries = args.tiles.starts[tiles];
  in_parts(args.threads, [&](int part) {
    const int64_t begin = count * part / args.threads, end = count * (part + 1) / args.threads;
    memset(weight_sum + begin, 0, size_t(end - begin) * sizeof(float));
    for (int64_t entry = 0; entry < entries; ++entry) {
      const int32_t id = args.tiles.ids[entry];
      if (id >= begin && id < end) weight_sum[id] += args.entry_weights[entry];
    }
  });
}

}  // namespace rtgs::RTGS_ISA
