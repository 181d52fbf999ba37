// Kernels of split_sum.h for pixels, kLanes at a time.
#include "common/parallel.h"
#include "image/split_sum.h"

#include "image/vectors.h"

namespace rtgs::RTGS_ISA {
namespace {

inline vfloat within(vfloat a, float low, float high) {  // what is no number stays none
  return select(lt(a, broadcast(low)), broadcast(low), select(gt(a, broadcast(high)), broadcast(high), a));
}

struct Cell {  // where shares of the table's side fall
  vint index;
  vfloat share;

  Cell(vfloat place, int side) {
    const vfloat scaled = place * float(side - 1);
    index = truncate(min(max(scaled, broadcast(0.f)), broadcast(float(side - 2))));  // a number also where place is none
    share = scaled - to_float(index);
  }
};

struct Lobe {  // A and B of kLanes lobes, and how they depend on the place in the table
  vfloat scale, offset, scale_across, offset_across, scale_down, offset_down;
  vmask cosine_inside, roughness_inside;

  Lobe(const LobePixels& in, int64_t first, int lanes) {
    const vfloat cosine = load_first(in.cosine + first, lanes), raw = load_first(in.roughness + first, lanes);
    const vfloat roughness = select(lt(raw, broadcast(in.smallest_roughness)), broadcast(in.smallest_roughness), raw);
    const vfloat width = roughness * roughness;
    const Cell column(within(cosine, 0.f, 1.f), in.side);
    const Cell row(sqrt(within(width, 0.f, in.widest) / in.widest), in.side);
    cosine_inside = ge(cosine, broadcast(0.f)) & ge(broadcast(1.f), cosine);
    roughness_inside = ge(raw, broadcast(in.smallest_roughness)) & ge(broadcast(in.widest), width);
    const vint entry = 2 * (row.index * in.side + column.index), below = entry + 2 * in.side;
    blend(in.table, entry, below, column.share, row.share, &scale, &scale_across, &scale_down);
    blend(in.table + 1, entry, below, column.share, row.share, &offset, &offset_across, &offset_down);
  }

  static void blend(const float* table, vint entry, vint below, vfloat across, vfloat down, vfloat* value,
                    vfloat* by_across, vfloat* by_down) {
    const vfloat a = gather(table, entry), b = gather(table, entry + 2);
    const vfloat c = gather(table, below), d = gather(table, below + 2);
    const vfloat top = fma(across, b - a, a), bottom = fma(across, d - c, c);
    *value = fma(down, bottom - top, top);
    *by_across = fma(down, (d - c) - (b - a), b - a);
    *by_down = bottom - top;
  }
};

}  // namespace

void lobe_weight(const LobePixels& in, float* weight) {
  each_block(in.threads, in.count, kLanes, [&](int64_t first) {
    const int lanes = lanes_at(first, in.count);
    const Lobe lobe(in, first, lanes);
    for (int64_t c = 0; c < in.colors; ++c) {
      const int64_t at = c * in.count + first;
      store_first(weight + at, fma(load_first(in.reflectance + at, lanes), lobe.scale, lobe.offset), lanes);
    }
  });
}

void lobe_weight_backward(const LobePixels& in, const float* upstream, const LobeGradients& out) {
  const float steps = float(in.side - 1), slope = steps / __builtin_sqrtf(in.widest);
  each_block(in.threads, in.count, kLanes, [&](int64_t first) {
    const int lanes = lanes_at(first, in.count);
    const Lobe lobe(in, first, lanes);
    vfloat to_scale{}, to_offset{};
    for (int64_t c = 0; c < in.colors; ++c) {
      const int64_t at = c * in.count + first;
      const vfloat up = load_first(upstream + at, lanes);
      to_scale = fma(up, load_first(in.reflectance + at, lanes), to_scale);
      to_offset += up;
      store_first(out.reflectance + at, up * lobe.scale, lanes);
    }
    const vfloat across = to_scale * lobe.scale_across + to_offset * lobe.offset_across;
    const vfloat down = to_scale * lobe.scale_down + to_offset * lobe.offset_down;
    store_first(out.cosine + first, where(lobe.cosine_inside, across * steps), lanes);
    store_first(out.roughness + first, where(lobe.roughness_inside, down * slope), lanes);
  });
}

namespace {

struct Mean {  // kLanes pixels: mean normals, and what they mirror
  Vector normal, outward, direction;  // the direction is of unit length where it is long enough
  vfloat inverse, inverse_direction, cosine;
  vmask divided, long_direction;  // the normal's divisor depends on what it is divided by; the direction's on itself

  Mean(const MeanPixels& in, int64_t first, int lanes) {
    const Vector sum = load_planes(in.normal, in.count, first, lanes);
    const Vector view = load_planes(in.view, in.count, first, lanes);
    const float least = in.shortest * in.shortest;
    if (in.unit) {
      const vfloat square = dot(sum, sum);
      divided = ge(square, broadcast(least));
      inverse = 1.f / sqrt(select(divided, square, broadcast(least)));
    } else {
      const vfloat alpha = load_first(in.alpha + first, lanes);
      divided = ge(alpha, broadcast(in.smallest_alpha));
      inverse = 1.f / select(lt(alpha, broadcast(in.smallest_alpha)), broadcast(in.smallest_alpha), alpha);
    }
    const vfloat inverse_view = 1.f / sqrt(dot(view, view));
    for (int k = 0; k < 3; ++k) {
      normal.v[k] = sum.v[k] * inverse;
      outward.v[k] = -view.v[k] * inverse_view;
    }
    cosine = dot(normal, outward);
    for (int k = 0; k < 3; ++k) direction.v[k] = 2.f * cosine * normal.v[k] - outward.v[k];
    const vfloat square = dot(direction, direction);
    long_direction = ge(square, broadcast(least));
    inverse_direction = 1.f / sqrt(select(lt(square, broadcast(least)), broadcast(least), square));
    for (int k = 0; k < 3; ++k) direction.v[k] *= inverse_direction;
  }
};

}  // namespace

void mean_mirror(const MeanPixels& in, float* directions, float* cosine) {
  each_block(in.threads, in.count, kLanes, [&](int64_t first) {
    const int lanes = lanes_at(first, in.count);
    const Mean mean(in, first, lanes);
    store_vectors(directions, first, lanes, mean.direction);
    store_first(cosine + first, mean.cosine, lanes);
  });
}

void mean_mirror_backward(const MeanPixels& in, const float* to_directions, const float* to_cosine,
                          const MeanGradients& out) {
  each_block(in.threads, in.count, kLanes, [&](int64_t first) {
    const int lanes = lanes_at(first, in.count);
    const Mean mean(in, first, lanes);
    Vector up = load_vectors(to_directions, first, lanes), to_normal;
    const vfloat radial = where(mean.long_direction, dot(up, mean.direction));
    for (int k = 0; k < 3; ++k) up.v[k] = mean.inverse_direction * (up.v[k] - radial * mean.direction.v[k]);
    const vfloat by_cosine = 2.f * dot(up, mean.normal) + load_first(to_cosine + first, lanes);
    for (int k = 0; k < 3; ++k) to_normal.v[k] = 2.f * mean.cosine * up.v[k] + by_cosine * mean.outward.v[k];
    const vfloat along = where(mean.divided, dot(to_normal, mean.normal));
    if (in.unit)
      for (int k = 0; k < 3; ++k) to_normal.v[k] -= along * mean.normal.v[k];
    for (int k = 0; k < 3; ++k) to_normal.v[k] *= mean.inverse;
    store_planes(out.normal, in.count, first, lanes, to_normal);
    store_first(out.alpha + first, in.unit ? vfloat{} : -along * mean.inverse, lanes);
  });
}

}  // namespace rtgs::RTGS_ISA
