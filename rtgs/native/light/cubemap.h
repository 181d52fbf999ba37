// Seamless cubemaps: lookup along directions, and filters that are linear in the texels. Twins: rtgs/light/lookup.py,
// rtgs/light/prefilter.py; geometry: rtgs/light/faces.py.
#pragma once
#include <cstdint>

namespace rtgs {

constexpr int kMaxCubeLevels = 16;

// Levels one behind the other, each (6, side + 2, side + 2, 4): rgb and a zero, with a border from the next faces.
struct CubePyramid {
  const float* texels;
  int levels;
  int32_t side[kMaxCubeLevels];
  int32_t start[kMaxCubeLevels];  // first row of 4 floats of each level
};

struct CubeRays {
  int64_t count;
  const float* directions;  // (P, 3), any length
  const float* level;       // (P) place between levels, 0: the first; or null: there is one level
  int threads;
};

struct CubeGradients {
  float* texels;      // as CubePyramid::texels, zero beforehand
  float* directions;  // (P, 3)
  float* level;       // (P), or null
};

struct CubeBorder {
  int64_t places, corners;
  const int32_t* source;  // (places) texel at each place
  const int32_t* corner;  // (corners, 4) place, three texels whose mean it is
};

// y[i] = after[i] sum over j of K[i, j] before[j] x[j]. K is symmetric, and stays what it is where an axis is mirrored:
// rows are there for the texels of one octant alone.
struct CubeFilter {
  int64_t texels, rows;
  const int32_t* texel;   // (rows) texels of the first octant
  const int64_t* start;   // (rows + 1) into columns and weights
  const int32_t* column;
  const float* weight;
  const int32_t* images;  // (8, texels)
  const float *before, *after;  // (texels)
  int threads;
};

void cube_pad(const CubeBorder& b, const float* texels, float* padded);
void cube_fold(const CubeBorder& b, const float* padded, int64_t texels, float* folded);

#define RTGS_DECLARE_LIGHT_KERNELS(isa)                                                                       \
  namespace isa {                                                                                             \
  void cube_lookup(const CubePyramid& pyramid, const CubeRays& rays, float* color);                           \
  void cube_lookup_backward(const CubePyramid& pyramid, const CubeRays& rays, const float* upstream,          \
                            const CubeGradients& out);                                                        \
  void cube_filter(const CubeFilter& f, const float* x, float* spread, float* y);                             \
  }
RTGS_DECLARE_LIGHT_KERNELS(portable)
#if defined(__x86_64__)
RTGS_DECLARE_LIGHT_KERNELS(avx2)
RTGS_DECLARE_LIGHT_KERNELS(avx512)
#endif
#undef RTGS_DECLARE_LIGHT_KERNELS

}  // namespace rtgs
