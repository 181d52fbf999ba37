// Which pixels are traced, in an order that keeps neighbours together, and which of them share a mirror ray.
// Twin: rtgs/methods/shading/traced_pixels.py.
#pragma once
#include <cstdint>

namespace rtgs {

// The N pixels of an image in their order: index into the image, 2x2 block, place in it (0 .. 3).
struct PixelOrder {
  int64_t count;
  const int64_t *index, *quad, *corner;
};

// Writes the pixels that are on the surface (N, by the index) and kept (N, in the order; null: all) to `index`, and to
// `place` where each of them stands in the order. Returns their count.
int64_t choose_pixels(const PixelOrder&, const bool* surface, const bool* kept, int64_t* index, int32_t* place);

// One ray for the sharing ones of each 2x2 block of `chosen` pixels: that whose turn, its corner plus `turn`, is first.
struct SharingPixels {
  int64_t count;
  const int32_t* place;  // in the order
  const int64_t* index;
  const float* showing;  // (N) by the index
  float below;           // what shows less shares
  int turn;
};
struct SharedRows {
  int64_t* own;    // rows of the chosen whose ray is traced
  int64_t* ray;    // of each chosen one: whose of `own` it shows
  int32_t* first;  // (largest quad + 1) scratch
};
int64_t share_rays(const PixelOrder&, const SharingPixels&, const SharedRows&, int64_t quads);  // returns how many own

}  // namespace rtgs
