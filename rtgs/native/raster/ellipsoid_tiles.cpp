// The ellipsoids' passes over tiles, forward and backward.
#include "raster/ellipsoid_footprint.h"
#include "raster/backward.h"
#include "raster/forward.h"

namespace rtgs::RTGS_ISA {
namespace {

template <int C>
struct Forward {
  static void run(const ForwardArgs& args) { forward_of<EllipsoidFootprint, C>(args); }
};

template <int C>
struct Backward {
  static void run(const BackwardArgs& args) { backward_by_signal<EllipsoidFootprint, C, false>(args); }
};

}  // namespace

void ellipsoid_forward(const ForwardArgs& args) { for_channels<Forward>(args.gaussians.layout.padded_channels, args); }

void ellipsoid_backward(const BackwardArgs& args, int64_t count) {
  for_channels<Backward>(args.forward.gaussians.layout.padded_channels, args);
  if (args.forward.threads > 1) add_waiting(args, count);
}

}  // namespace rtgs::RTGS_ISA
