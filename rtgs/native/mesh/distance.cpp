#include "mesh/distance.h"

#include <cmath>

namespace rtgs {
namespace {

// To the nearest pixel of the other kind in the same column, for both kinds: own[p] is 0 where p is of that kind.
void down_columns(int64_t height, int64_t width, const bool* inside, int32_t far, int32_t* in, int32_t* out) {
  for (int64_t p = 0; p < height * width; ++p) {
    const int32_t from_in = p < width ? far : in[p - width] + 1, from_out = p < width ? far : out[p - width] + 1;
    in[p] = inside[p] ? 0 : from_in < far ? from_in : far;
    out[p] = !inside[p] ? 0 : from_out < far ? from_out : far;
  }
  for (int64_t p = (height - 1) * width - 1; p >= 0; --p) {
    in[p] = in[p] <= in[p + width] ? in[p] : in[p + width] + 1;
    out[p] = out[p] <= out[p + width] ? out[p] : out[p + width] + 1;
  }
}

// The lower envelope of the parabolas (x - i)^2 + g[i]^2 (Felzenszwalb and Huttenlocher 2012), in whole numbers as
// Meijster, Roerdink and Hesselink 2000 compare them: parabola i wins over an earlier one from `begin` on.
class Envelope {
 public:
  Envelope(int64_t width, int32_t* scratch) : width_(width), vertex_(scratch), begin_(scratch + width) {}

  void build(const int32_t* g) {
    g_ = g, last_ = 0, vertex_[0] = 0, begin_[0] = 0;
    for (int64_t i = 1; i < width_; ++i) {
      while (last_ >= 0 && square(begin_[last_], vertex_[last_]) > square(begin_[last_], i)) --last_;
      const int64_t from = last_ < 0 ? 0 : 1 + meeting(vertex_[last_], i);
      if (from < width_) ++last_, vertex_[last_] = int32_t(i), begin_[last_] = int32_t(from);
    }
  }
  // Squared distances of the row, asked for from its end on.
  int64_t at(int64_t x) {
    while (begin_[last_] > x) --last_;
    return square(x, vertex_[last_]);
  }

 private:
  int64_t square(int64_t x, int64_t i) const { return (x - i) * (x - i) + int64_t(g_[i]) * g_[i]; }
  int64_t meeting(int64_t a, int64_t b) const {  // the last x at which a is not farther than b; rounded down
    const int64_t twice = b * b - a * a + int64_t(g_[b]) * g_[b] - int64_t(g_[a]) * g_[a], span = 2 * (b - a);
    return twice >= 0 ? twice / span : -((-twice + span - 1) / span);
  }
  const int64_t width_;
  int32_t *const vertex_, *const begin_;
  const int32_t* g_ = nullptr;
  int64_t last_ = 0;
};

}  // namespace

void outline_distance(int64_t height, int64_t width, const bool* inside, int32_t* scratch, float* distance) {
  int32_t *in = scratch, *out = in + height * width;
  down_columns(height, width, inside, int32_t(height + width), in, out);
  Envelope envelope(width, out + height * width);
  const auto fill = [&](int64_t first, bool kind) {  // those pixels of a row that are inside, or those that are not
    envelope.build((kind ? out : in) + first);
    for (int64_t x = width - 1; x >= 0; --x) {
      if (inside[first + x] != kind) continue;
      const double away = std::sqrt(double(envelope.at(x)));
      distance[first + x] = float(kind ? away - 0.5 : 0.5 - away);
    }
  };
  for (int64_t row = 0; row < height; ++row) fill(row * width, true), fill(row * width, false);
}

}  // namespace rtgs
