// The surfels' backward pass over tiles, and what backward passes of every kind of Gaussian share.
#include "common/parallel.h"
#include "raster/backward.h"

#include "raster/surfel_footprint.h"

namespace rtgs::RTGS_ISA {

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

// Each thread takes a share of the Gaussians, so that the order of additions to a row is that of the tiles.
void add_waiting(const BackwardArgs& args, int64_t count) {
  const int threads = args.forward.threads;
  const RecordLayout& layout = args.forward.gaussians.layout;
  in_parts(threads, [&](int part) {
    const int64_t begin = count * part / threads, end = count * (part + 1) / threads;
    for (int range = 1; range < threads; ++range) {
      const int64_t first = args.forward.tiles.starts[args.range_starts[range]];
      for (int64_t k = first; k < first + args.waiting_counts[range]; ++k) {
        const int64_t id = args.waiting_ids[k];
        if (id < begin || id >= end) continue;
        const float* from = args.waiting_rows + layout.gradient_stride * k;
        float* row = args.rows + layout.gradient_stride * id;
        for (int j = 0; j < layout.gradient_sums; j += kLanes) store(row + j, load(row + j) + load(from + j));
      }
    }
  });
}

namespace {

template <int C>
struct Backward {
  static void run(const BackwardArgs& args) { backward_of<SurfelFootprint, C>(args); }
};

}  // namespace

void raster_backward(const BackwardArgs& args, int64_t count) {
  for_channels<Backward>(args.forward.gaussians.layout.padded_channels, args);
  if (args.forward.threads > 1) add_waiting(args, count);
}

}  // namespace rtgs::RTGS_ISA
