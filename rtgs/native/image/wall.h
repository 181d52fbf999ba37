// Thin walls of glass: what they reflect, the light that comes to one of them along a path inside the object, and what
// is seen through the far one, and how much pixels show of all that. Twins: rtgs/optics/dielectric.py, and
// rtgs/methods/shading/inner.py, far_wall.py and wall_weights.py beside it.
#pragma once
#include <cstdint>

namespace rtgs {

// Sums over all rows are partial sums of blocks of so many, which the caller adds in their order.
constexpr int64_t kWallBlock = 1024;

struct WallAngles {
  int64_t count;
  const float* cosine;  // (P) of the angle of incidence, in air; any value
  float index;          // of refraction
  int threads;
};

struct Glass {
  float index;
  bool tinted;
  float tint[3];  // of light that passes
};
constexpr int kGlassNumbers = 4;  // in sums: by the index, by the tint

struct WallLeg {  // L rays inside the object, each to a wall
  int64_t count;
  const float *contents, *alpha, *surroundings;  // (L, 3), (L), (L, 3): encoded
  const float* later;                            // (L, 3) linear light mirrored at that wall; null: none
  const float *cosine, *wall;                    // (L) there, (L) 1: there is one, 0: none
  Glass glass;
  int threads;
};
struct WallLegGradients {  // later: null without it; glass: (blocks, kGlassNumbers) partial sums
  float *contents, *alpha, *surroundings, *later, *cosine, *glass;
};

struct FarWall {  // R rays through an object
  int64_t count;
  const float *contents, *alpha;               // (3, R) encoded, (R); no alpha: the rest is added to the contents
  const float* behind;                         // (B, 3) encoded; one row that can be read where there are none
  const float *arriving, *cosine;              // (K, 3) linear, (K): of rays with a wall that mirrors; the same
  const int32_t *behind_place, *mirror_place;  // (whole registers of R) a ray's row of these; -1: it has none
  Glass glass;
  int threads;
};
struct FarWallGradients {  // alpha: null without it; glass: (blocks, kGlassNumbers) partial sums
  float *alpha, *behind, *arriving, *cosine, *glass;
};

constexpr int kNoGlass = -2;
struct WallPixels {  // P traced pixels
  int64_t count;
  const float *reflection, *cosine;  // (P) w_r where there is no glass, n . omega_o
  const float* walls;                // (P) 1: there is a wall, 0: an opening; null: 1
  // (whole registers of P) a pixel's row at the outline; -1: it is glass elsewhere; kNoGlass
  const int32_t* place;
  // (P) k_s, and of rows at the outline R, the share that meets a wall, and a; null: no pixel is there
  const float *specular, *edge_reflected, *edge_wall, *edge_share;
  Glass glass;
  int threads;
};
struct WallPixelWeights {  // (P) w_r, (P) or with a tint (3, P) w_t, (P) of what is beside or null: nothing is
  float *reflection, *passing, *beside;
};
struct WallPixelUpstream {  // the same
  const float *reflection, *passing, *beside;
};
struct WallPixelGradients {  // specular and edge_reflected: null without an outline; glass: as above
  float *reflection, *cosine, *specular, *edge_reflected, *glass;
};

#define RTGS_DECLARE_WALL_KERNELS(isa)                                                                    \
  namespace isa {                                                                                         \
  void wall_reflectance(const WallAngles&, float* reflected);                                             \
  void wall_reflectance_backward(const WallAngles&, const float* upstream, float* cosine, float* index);  \
  void wall_leg(const WallLeg&, float* arriving);                                                         \
  void wall_leg_backward(const WallLeg&, const float* upstream, const WallLegGradients&);                 \
  void far_wall(const FarWall&, float* color);                                                            \
  void far_wall_backward(const FarWall&, const float* upstream, const FarWallGradients&);                 \
  void wall_weights(const WallPixels&, const WallPixelWeights&);                                          \
  void wall_weights_backward(const WallPixels&, const WallPixelUpstream&, const WallPixelGradients&);     \
  }  // index: (blocks) partial sums; color, upstream: (3, R)
RTGS_DECLARE_WALL_KERNELS(portable)
#if defined(__x86_64__)
RTGS_DECLARE_WALL_KERNELS(avx2)
RTGS_DECLARE_WALL_KERNELS(avx512)
#endif
#undef RTGS_DECLARE_WALL_KERNELS

}  // namespace rtgs
