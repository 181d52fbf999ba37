// What masks say about points in space: signed distances to their outlines, what all but k views allow, votes, and how
// many views show a point in front of what is opaque.
// Twins: tests/mesh/outline_twins.py.
#pragma once
#include <cstdint>

namespace rtgs {

constexpr float kUnseen = 1e9f;  // instead of a distance: the view says nothing about the point (HIDDEN in Python)

struct Pinhole {
  double rotation[9], translation[3];  // world to camera
  double fx, fy, cx, cy;
  int64_t width, height;  // of the picture, 2^24 at most, and 2^30 pixels in all
};

struct OutlineView {
  Pinhole camera;
  float focal;           // pixels: (fx fy)^(1/2)
  const float* whole;    // (H, W) signed distance to the outline of mask and hidden pixels, positive inside
  const float* bare;     // (H, W) of the mask alone; null: no pixel is hidden
  const float* surface;  // (H, W) z-depth before which a hidden pixel shows free space; read with `bare` only
  const bool* hidden;    // (H, W)
};

struct DepthView {
  Pinhole camera;
  const bool* mask;    // (H, W)
  const float* depth;  // (H, W) z-depth of the first opaque surface; 0: none
};

struct SpacePoints {
  int64_t count;
  const double* points;  // (N, 3) world
  int threads;
};
struct OutlinePoints {
  SpacePoints in;
  int64_t views;
  const OutlineView* view;
};
struct DepthPoints {
  SpacePoints in;
  int64_t views;
  const DepthView* view;
  double margin;  // world units that a point may lie behind the surface
};

// Points of a block are worked on together: scratch of a thread holds `ranks` rows of so many floats.
constexpr int kOutlineBlock = 512;

struct OutvotingNumbers {
  int64_t counts, ranks;  // how many k; the largest of them and one
  const int64_t* k;       // (counts)
  int64_t min_seen;       // views that must have a point in the picture
  int64_t min_heard;      // views that must say something about it
};

#define RTGS_DECLARE_OUTLINE_KERNELS(isa)                                                              \
  namespace isa {                                                                                      \
  void outline_distances(const OutlinePoints&, float* distance);                                       \
  void outvoting(const OutlinePoints&, const OutvotingNumbers&, float* scratch, float* distance);      \
  void outline_votes(const OutlinePoints&, float* inside, float* seen);                                \
  void views_in_front(const DepthPoints&, int64_t* views);                                             \
  }  // distance: (V, N), (counts, N); inside, seen, views: (N); scratch: (threads, ranks, kOutlineBlock)
RTGS_DECLARE_OUTLINE_KERNELS(portable)
#if defined(__x86_64__)
RTGS_DECLARE_OUTLINE_KERNELS(avx2)
RTGS_DECLARE_OUTLINE_KERNELS(avx512)
#endif
#undef RTGS_DECLARE_OUTLINE_KERNELS

}  // namespace rtgs
