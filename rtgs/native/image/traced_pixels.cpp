// traced_pixels.h: single passes over the pixels, whose results depend on those before.
#include "image/traced_pixels.h"

namespace rtgs {
namespace {

constexpr int32_t kNobody = 4;  // above every turn

}  // namespace

int64_t choose_pixels(const PixelOrder& order, const bool* surface, const bool* kept, int64_t* index, int32_t* place) {
  int64_t found = 0;  // without a branch: surfaces and gaps alternate
  for (int64_t k = 0; k < order.count; ++k) {
    const int64_t pixel = order.index[k];
    index[found] = pixel;
    place[found] = int32_t(k);
    found += surface[pixel] & (kept ? kept[k] : true);
  }
  return found;
}

int64_t share_rays(const PixelOrder& order, const SharingPixels& in, const SharedRows& out, int64_t quads) {
  for (int64_t quad = 0; quad < quads; ++quad) out.first[quad] = kNobody;
  const auto turn_of = [&](int64_t k) { return int32_t((order.corner[in.place[k]] + in.turn) & 3); };
  const auto sharing = [&](int64_t k) { return in.showing[in.index[k]] < in.below; };
  for (int64_t k = 0; k < in.count; ++k) {
    int32_t& first = out.first[order.quad[in.place[k]]];
    const int32_t turn = sharing(k) ? turn_of(k) : kNobody;
    first = turn < first ? turn : first;
  }
  int64_t rays = 0;
  for (int64_t k = 0; k < in.count; ++k) {  // a pixel that leads its block puts the ray where its turn was
    int32_t& first = out.first[order.quad[in.place[k]]];
    const bool shares = sharing(k), leads = shares && turn_of(k) == first;
    out.own[rays] = k;
    out.ray[k] = rays;
    if (leads) first = -1 - int32_t(rays);
    rays += !shares || leads;
  }
  for (int64_t k = 0; k < in.count; ++k)
    if (sharing(k)) out.ray[k] = -1 - out.first[order.quad[in.place[k]]];
  return rays;
}

}  // namespace rtgs
