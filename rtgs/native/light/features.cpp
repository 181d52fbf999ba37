// Kernels of features.h. Pixels go through the network in blocks, a row each; what the backward pass needs of the
// layers it makes again, so that memory does not grow with the width of the network.
#include <cmath>
#include <cstring>

#include "common/parallel.h"
#include "common/simd.h"
#include "light/feature_lookup.h"
#include "light/features.h"

namespace rtgs::RTGS_ISA {
namespace {

constexpr float kBrightest = 5.f, kShortest = 1e-12f;
constexpr int kTileRows = 8, kTileRegisters = kLanes == 16 ? 2 : 1;

struct Matrix {  // element (m, k) at data[m * row + k * column]
  const float* data;
  int64_t row, column;
};

template <int R>
inline void tile(const Matrix& a, const float* b, int64_t b_row, float* c, int64_t c_row, int depth) {
  vfloat sum[kTileRows][R];
  for (int m = 0; m < kTileRows; ++m)
    for (int r = 0; r < R; ++r) sum[m][r] = load(c + m * c_row + r * kLanes);
  for (int k = 0; k < depth; ++k) {
    vfloat row[R];
    for (int r = 0; r < R; ++r) row[r] = load(b + k * b_row + r * kLanes);
#pragma GCC unroll 8
    for (int m = 0; m < kTileRows; ++m) {
      const vfloat value = broadcast(a.data[m * a.row + k * a.column]);
      for (int r = 0; r < R; ++r) sum[m][r] = fma(value, row[r], sum[m][r]);
    }
  }
  for (int m = 0; m < kTileRows; ++m)
    for (int r = 0; r < R; ++r) store(c + m * c_row + r * kLanes, sum[m][r]);
}

// C (M, N) += A (M, depth) B (depth, N), rows of B and C dense up to N; M a multiple of 8, N of 16.
inline void multiply(const Matrix& a, const float* b, float* c, int M, int N, int depth) {
  for (int n = 0; n < N;) {
    const bool wide = n + kTileRegisters * kLanes <= N;
    for (int m = 0; m < M; m += kTileRows) {
      const Matrix rows = {a.data + m * a.row, a.row, a.column};
      float* to = c + int64_t(m) * N + n;
      if (wide) tile<kTileRegisters>(rows, b + n, N, to, N, depth);
      else tile<1>(rows, b + n, N, to, N, depth);
    }
    n += wide ? kTileRegisters * kLanes : kLanes;
  }
}

struct Block {  // scratch of one chunk, a row for each pixel
  float *input, *hidden, *deep, *color;
  float *by_input, *by_hidden, *by_deep, *by_color;
};

inline Block block_of(float* scratch, int width) {
  Block b;
  b.input = scratch;
  b.by_input = b.input + kFeatureBlock * kInputs;
  b.color = b.by_input + kFeatureBlock * kInputs;
  b.by_color = b.color + kFeatureBlock * kColors;
  b.hidden = b.by_color + kFeatureBlock * kColors;
  b.deep = b.hidden + kFeatureBlock * width;
  b.by_hidden = b.deep + kFeatureBlock * width;
  b.by_deep = b.by_hidden + kFeatureBlock * width;
  return b;
}

inline float unit_of(const float* surface, float* unit) {  // returns the length
  float square = 0.f;
  for (int s = 0; s < kSurface; ++s) square += surface[s] * surface[s];
  const float length = std::sqrt(square), inverse = 1.f / (length > kShortest ? length : kShortest);
  for (int s = 0; s < kSurface; ++s) unit[s] = surface[s] * inverse;
  return length;
}

inline void inputs_of(const float* found, const float* surface, float* input) {
  float unit[kSurface];
  unit_of(surface, unit);
  for (int d = 0; d < kDirection; ++d)
    for (int s = 0; s < kSurface; ++s) input[d * kSurface + s] = found[d] * unit[s];
  for (int d = 0; d < kDirection; ++d) input[kDirection * kSurface + d] = found[d];
}

inline void fill_rows(const float* bias, float* rows, int width) {
  for (int p = 0; p < kFeatureBlock; ++p) memcpy(rows + int64_t(p) * width, bias, sizeof(float) * width);
}

inline void relu(float* values, int64_t count) {  // what is no number stays none
  const vfloat zero = {};
  for (int64_t k = 0; k < count; k += kLanes) {
    const vfloat value = load(values + k);
    store(values + k, select(gt(zero, value), zero, value));
  }
}

inline void relu_backward(const float* values, float* gradient, int64_t count) {
  const vfloat zero = {};
  for (int64_t k = 0; k < count; k += kLanes)
    store(gradient + k, where(gt(load(values + k), zero), load(gradient + k)));
}

// Layers of a block whose inputs are there; logs of colours in `color`.
inline void layers_of(const FeatureNetwork& net, const Block& b) {
  fill_rows(net.first_bias, b.hidden, net.width);
  multiply({b.input, kInputs, 1}, net.first_t, b.hidden, kFeatureBlock, net.width, kInputs);
  relu(b.hidden, int64_t(kFeatureBlock) * net.width);
  fill_rows(net.second_bias, b.deep, net.width);
  multiply({b.hidden, net.width, 1}, net.second_t, b.deep, kFeatureBlock, net.width, net.width);
  relu(b.deep, int64_t(kFeatureBlock) * net.width);
  fill_rows(net.last_bias, b.color, kColors);
  multiply({b.deep, net.width, 1}, net.last_t, b.color, kFeatureBlock, kColors, net.width);
}

struct Share {  // pixels of one chunk
  int64_t begin, end;
};

inline Share share_of(int64_t count, int chunk) {
  const int64_t blocks = (count + kFeatureBlock - 1) / kFeatureBlock;
  const int64_t each = (blocks + kFeatureChunks - 1) / kFeatureChunks * kFeatureBlock;
  const int64_t begin = chunk * each, end = begin + each;
  return {begin < count ? begin : count, end < count ? end : count};
}

void forward_chunk(const FeatureMap& map, const FeatureNetwork& net, const FeatureRays& rays, const Block& b,
                   const Share& share, const FeatureSaved& saved, float* color) {
  for (int64_t begin = share.begin; begin < share.end; begin += kFeatureBlock) {
    const int count = int(share.end - begin < kFeatureBlock ? share.end - begin : kFeatureBlock);
    memset(b.input, 0, sizeof(float) * kFeatureBlock * kInputs);
    for (int p = 0; p < count; ++p) {
      const int64_t pixel = begin + p;
      float *found = saved.found + pixel * kDirection, *place = saved.places + 2 * pixel;
      place_of(rays.directions + 3 * pixel, place);
      const Levels at = levels_at(map, rays.level[pixel]);
      for (int f = 0; f < kDirection; ++f) found[f] = 0.f;
      add_texels(map, spot_at(map, at.first, place), 1.f - at.share, found);
      add_texels(map, spot_at(map, at.first + 1, place), at.share, found);
      inputs_of(found, rays.surface + kSurface * pixel, b.input + p * kInputs);
    }
    layers_of(net, b);
    for (int p = 0; p < count; ++p)
      for (int c = 0; c < 3; ++c) {
        const float log = b.color[p * kColors + c];
        color[3 * (begin + p) + c] = std::exp(log > kBrightest ? kBrightest : log);
      }
  }
}

inline void add_rows(const float* rows, int width, float* sum) {
  for (int p = 0; p < kFeatureBlock; ++p)
    for (int k = 0; k < width; ++k) sum[k] += rows[int64_t(p) * width + k];
}

// From gradients of the logs of colours to those of the inputs; adds those of the network.
inline void layers_backward(const FeatureNetwork& net, const Block& b, float* to) {
  const int width = net.width;
  float* to_first = to;
  float* to_second = to_first + int64_t(width) * kInputs;
  float* to_last = to_second + int64_t(width) * width;
  float* to_biases = to_last + 8 * int64_t(width);
  multiply({b.by_color, 1, kColors}, b.deep, to_last, 8, width, kFeatureBlock);
  add_rows(b.by_color, kColors, to_biases + 2 * width);
  memset(b.by_deep, 0, sizeof(float) * kFeatureBlock * width);
  multiply({b.by_color, kColors, 1}, net.last, b.by_deep, kFeatureBlock, width, 3);
  relu_backward(b.deep, b.by_deep, int64_t(kFeatureBlock) * width);
  multiply({b.by_deep, 1, width}, b.hidden, to_second, width, width, kFeatureBlock);
  add_rows(b.by_deep, width, to_biases + width);
  memset(b.by_hidden, 0, sizeof(float) * kFeatureBlock * width);
  multiply({b.by_deep, width, 1}, net.second, b.by_hidden, kFeatureBlock, width, width);
  relu_backward(b.hidden, b.by_hidden, int64_t(kFeatureBlock) * width);
  multiply({b.by_hidden, 1, width}, b.input, to_first, width, kInputs, kFeatureBlock);
  add_rows(b.by_hidden, width, to_biases);
  memset(b.by_input, 0, sizeof(float) * kFeatureBlock * kInputs);
  multiply({b.by_hidden, width, 1}, net.first, b.by_input, kFeatureBlock, kInputs, width);
}

inline void inputs_backward(const float* found, const float* surface, const float* by_input, float* by_found,
                            float* by_surface) {
  float unit[kSurface], by_unit[kSurface] = {};
  const float length = unit_of(surface, unit);
  for (int d = 0; d < kDirection; ++d) {
    float sum = by_input[kDirection * kSurface + d];
    for (int s = 0; s < kSurface; ++s) {
      sum += by_input[d * kSurface + s] * unit[s];
      by_unit[s] += by_input[d * kSurface + s] * found[d];
    }
    by_found[d] = sum;
  }
  float along = 0.f;
  for (int s = 0; s < kSurface; ++s) along += by_unit[s] * unit[s];
  const bool short_one = length <= kShortest;  // as torch's normalize: divided by the least length
  for (int s = 0; s < kSurface; ++s)
    by_surface[s] = short_one ? by_unit[s] * (1.f / kShortest) : (by_unit[s] - unit[s] * along) / length;
}

inline void lookup_backward(const FeatureMap& map, const FeatureRays& rays, const FeatureSaved& saved, int64_t pixel,
                            const FeatureGradients& out) {
  const float *place = saved.places + 2 * pixel, *upstream = out.found + pixel * kDirection;
  const Levels at = levels_at(map, rays.level[pixel]);
  float by_place[2] = {}, value[2];
  for (int k = 0; k < 2; ++k) {
    const float scale = (k ? at.share : 1.f - at.share) * float(map.side[at.first + k]);
    float by_column, by_row;
    value[k] = texels_backward(map, spot_at(map, at.first + k, place), upstream, &by_column, &by_row);
    by_place[0] += 2.f * scale * by_column;
    by_place[1] += scale * by_row;
  }
  out.level[pixel] = at.inside ? value[1] - value[0] : 0.f;
  place_backward(rays.directions + 3 * pixel, by_place, out.directions + 3 * pixel);
}

void backward_chunk(const FeatureMap& map, const FeatureNetwork& net, const FeatureRays& rays, const Block& b,
                    const Share& share, const FeatureSaved& saved, const float* upstream, float* to_network,
                    const FeatureGradients& out) {
  for (int64_t begin = share.begin; begin < share.end; begin += kFeatureBlock) {
    const int count = int(share.end - begin < kFeatureBlock ? share.end - begin : kFeatureBlock);
    memset(b.input, 0, sizeof(float) * kFeatureBlock * kInputs);
    for (int p = 0; p < count; ++p)
      inputs_of(saved.found + (begin + p) * kDirection, rays.surface + kSurface * (begin + p), b.input + p * kInputs);
    layers_of(net, b);
    memset(b.by_color, 0, sizeof(float) * kFeatureBlock * kColors);
    for (int p = 0; p < count; ++p)
      for (int c = 0; c < 3; ++c) {
        const float log = b.color[p * kColors + c];
        b.by_color[p * kColors + c] = log > kBrightest ? 0.f : upstream[3 * (begin + p) + c] * std::exp(log);
      }
    layers_backward(net, b, to_network);
    for (int p = 0; p < count; ++p) {
      const int64_t pixel = begin + p;
      inputs_backward(saved.found + pixel * kDirection, rays.surface + kSurface * pixel, b.by_input + p * kInputs,
                      out.found + pixel * kDirection, out.surface + kSurface * pixel);
      lookup_backward(map, rays, saved, pixel, out);
    }
  }
}

inline void add_scaled(float* to, float scale, const float* from) {
  for (int f = 0; f < kDirection; ++f) to[f] += scale * from[f];
}

// Gradients of the texels of every `bands`-th row from `band` on, in the order of the pixels.
void texels_of_band(const FeatureMap& map, const FeatureRays& rays, const FeatureSaved& saved, int band, int bands,
                    const FeatureGradients& out) {
  for (int64_t pixel = 0; pixel < rays.count; ++pixel) {
    const Levels at = levels_at(map, rays.level[pixel]);
    for (int k = 0; k < 2; ++k) {
      const float scale = k ? at.share : 1.f - at.share;
      if (scale == 0.f) continue;
      const Spot spot = spot_at(map, at.first + k, saved.places + 2 * pixel);
      float share[4];
      corner_shares(spot, scale, share);
      for (int corner = 0; corner < 4; ++corner) {
        const int64_t line = spot.texel[corner] / (2 * map.side[at.first + k]);
        if (bands > 1 && line % bands != band) continue;
        add_scaled(out.texels + spot.texel[corner] * kDirection, share[corner], out.found + pixel * kDirection);
      }
    }
  }
}

}  // namespace

void feature_light(const FeatureMap& map, const FeatureNetwork& network, const FeatureRays& rays, float* scratch,
                   const FeatureSaved& saved, float* color) {
  each_in_turns(rays.threads, kFeatureChunks, [&](int64_t chunk) {
    const Block block = block_of(scratch + chunk * feature_scratch(network.width), network.width);
    forward_chunk(map, network, rays, block, share_of(rays.count, int(chunk)), saved, color);
  });
}

void feature_light_backward(const FeatureMap& map, const FeatureNetwork& network, const FeatureRays& rays,
                            float* scratch, const FeatureSaved& saved, const float* upstream,
                            const FeatureGradients& out) {
  const int64_t weights = feature_weights(network.width);
  each_in_turns(rays.threads, kFeatureChunks, [&](int64_t chunk) {
    const Block block = block_of(scratch + chunk * feature_scratch(network.width), network.width);
    float* to = out.network + chunk * weights;
    backward_chunk(map, network, rays, block, share_of(rays.count, int(chunk)), saved, upstream, to, out);
  });
  for (int chunk = 1; chunk < kFeatureChunks; ++chunk)
    for (int64_t k = 0; k < weights; ++k) out.network[k] += out.network[chunk * weights + k];
  const int bands = rays.threads;
  in_parts(bands, [&](int band) { texels_of_band(map, rays, saved, band, bands, out); });
}

}  // namespace rtgs::RTGS_ISA
