// Faces with a border from their neighbours, and its gradient: copies, in a fixed order.
#include <cstring>

#include "light/cubemap.h"

namespace rtgs {

void cube_pad(const CubeBorder& b, const float* texels, float* padded) {
  for (int64_t place = 0; place < b.places; ++place) {
    const float* from = texels + 3 * int64_t(b.source[place]);
    float* to = padded + 4 * place;
    to[0] = from[0], to[1] = from[1], to[2] = from[2], to[3] = 0.f;
  }
  for (int64_t k = 0; k < b.corners; ++k) {
    const int32_t* row = b.corner + 4 * k;
    for (int c = 0; c < 3; ++c)
      padded[4 * int64_t(row[0]) + c] = (texels[3 * int64_t(row[1]) + c] + texels[3 * int64_t(row[2]) + c] +
                                         texels[3 * int64_t(row[3]) + c]) * (1.f / 3.f);
  }
}

void cube_fold(const CubeBorder& b, const float* padded, int64_t texels, float* folded) {
  std::memset(folded, 0, size_t(texels) * 3 * sizeof(float));
  int64_t k = 0;  // corners lie in the order of places
  for (int64_t place = 0; place < b.places; ++place) {
    const float* from = padded + 4 * place;
    if (k < b.corners && b.corner[4 * k] == place) {
      for (int source = 1; source < 4; ++source)
        for (int c = 0; c < 3; ++c) folded[3 * int64_t(b.corner[4 * k + source]) + c] += from[c] * (1.f / 3.f);
      ++k;
      continue;
    }
    float* to = folded + 3 * int64_t(b.source[place]);
    for (int c = 0; c < 3; ++c) to[c] += from[c];
  }
}

}  // namespace rtgs
