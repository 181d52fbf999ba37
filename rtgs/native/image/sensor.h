// What a photo can show of a picture. Twin: rtgs/train/terms.py.
#pragma once
#include <cstdint>

namespace rtgs {

struct SensorPicture {
  int64_t count;
  const float *image, *photo;
  float brightest;  // a photo's value from which on the light may have been more
  int threads;
};
// Of the image, or of its upstream gradient: what is above 1 where the photo is at its brightest is 1, or 0.
void cut_light(const SensorPicture&, float* to);
void cut_light_backward(const SensorPicture&, const float* upstream, float* to);

}  // namespace rtgs
