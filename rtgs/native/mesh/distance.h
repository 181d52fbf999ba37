// Exact distances of an image's pixels to the outline of a mask. Twin: scipy.ndimage.distance_transform_edt, in
// tests/mesh/outline_twins.py.
#pragma once
#include <cstdint>

namespace rtgs {

// Writes (H, W) the distance in pixels to the outline, positive inside. The outline runs half a pixel from the centres
// on both sides of it; the picture's border is none. Some pixels are inside and some are not. scratch: 2 H W + 2 W.
void outline_distance(int64_t height, int64_t width, const bool* inside, int32_t* scratch, float* distance);

}  // namespace rtgs
