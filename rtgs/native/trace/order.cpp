// The order in which packets take rays: as they come, or along a Morton curve through directions and origins. Measured
// (docs/tracer.md): what decides the time of a packet is how far its rays are apart when they reach the surfels, so a
// direction counts by its angle and an origin by its distance in parts of the scene's size.
#include "common/parallel.h"
#include "common/radix.h"
#include "trace/trace.h"
#include "common/simd.h"

namespace rtgs::RTGS_ISA {
namespace {

constexpr int kAxes = 5;            // octahedral direction (2), origin (3)
constexpr int kKeyBits = 30, kMostAxisBits = 15;
constexpr float kOriginWeight = 1 / 0.7f;  // one unit of octahedral direction, some 2.5 radians, against one scene size
constexpr int kSampleStride = 16;   // of rays, for the guess how close sorted rays would be
constexpr float kWorthSorting = 1.4f;  // rays that come this much wider than sorted ones would be are sorted

struct Extent {
  float low[kAxes], high[kAxes];
};

float tree_size(const TreeView& tree) {
  const TreeNode& root = tree.nodes[0];
  float size = 0.f;
  for (int k = 0; k < 3; ++k) {
    float low = 3.4e38f, high = -3.4e38f;
    for (int child = 0; child < kNodeChildren; ++child) {
      if (root.low[k][child] < low) low = root.low[k][child];
      if (root.high[k][child] > high) high = root.high[k][child];
    }
    if (high - low > size) size = high - low;
  }
  return size > 0.f && size < 1e37f ? size : 1.f;
}

// Coordinates of all rays, one array per axis; rays that are not finite get zeros.
void ray_coordinates(const TraceRays& rays, float size, float* const* axes, int threads) {
  const float scale = kOriginWeight / size;
  each_block(threads, rays.count, kLanes, [&](int64_t first) {
    const int lanes = int(rays.count - first < kLanes ? rays.count - first : kLanes);
    const vint row = min_int(truncate(lane_numbers()), broadcast_int(lanes - 1)) * 3;
    const float *o = rays.origins + 3 * first, *d = rays.directions + 3 * first;
    const vfloat x = gather(d, row), y = gather(d + 1, row), z = gather(d + 2, row);
    const vfloat one = broadcast(1.f), zero = broadcast(0.f);
    const vfloat inverse = 1.f / max(abs(x) + abs(y) + abs(z), broadcast(1e-37f));
    const vfloat u = x * inverse, v = y * inverse;
    const vmask below = lt(z, zero);
    const vfloat folded_u = negated_where(lt(u, zero), one - abs(v)), folded_v = negated_where(lt(v, zero), one - abs(u));
    const vfloat coordinates[kAxes] = {0.5f * select(below, folded_u, u), 0.5f * select(below, folded_v, v),
                                       gather(o, row) * scale, gather(o + 1, row) * scale, gather(o + 2, row) * scale};
    for (int k = 0; k < kAxes; ++k)
      store_first(axes[k] + first, where(finite(coordinates[k]), coordinates[k]), lanes);
  });
}

Extent extent_of(const float* const* axes, int64_t count) {
  Extent e;
  for (int k = 0; k < kAxes; ++k) {
    vfloat low = broadcast(3e38f), high = broadcast(-3e38f);
    int64_t i = 0;
    for (; i + kLanes <= count; i += kLanes) low = min(low, load(axes[k] + i)), high = max(high, load(axes[k] + i));
    e.low[k] = smallest(low), e.high[k] = largest(high);
    for (; i < count; ++i) {
      if (axes[k][i] < e.low[k]) e.low[k] = axes[k][i];
      if (axes[k][i] > e.high[k]) e.high[k] = axes[k][i];
    }
  }
  return e;
}

// Morton key of cubic cells, as small as kKeyBits allow: an axis has the more bits the further the rays spread along it.
struct MortonCells {
  float low[kAxes], inverse_cell = 0.f;
  int bits[kAxes];
  int8_t from_axis[kKeyBits], from_bit[kKeyBits];  // of the key's bits, the highest first
  int used = 0;

  explicit MortonCells(const Extent& e) {
    float largest = 0.f;
    for (int k = 0; k < kAxes; ++k) {
      low[k] = e.low[k];
      if (e.high[k] - e.low[k] > largest) largest = e.high[k] - e.low[k];
    }
    if (!(largest > 1e-30f)) return;
    float cell = largest / float(1 << kMostAxisBits);
    while (count_bits(e, cell) > kKeyBits) cell *= 1.1f;
    inverse_cell = 1.f / cell;
    for (int bit = kMostAxisBits - 1; bit >= 0; --bit)
      for (int k = 0; k < kAxes; ++k)
        if (bits[k] > bit) from_axis[used] = int8_t(k), from_bit[used++] = int8_t(bit);
  }
  int count_bits(const Extent& e, float cell) {
    int total = 0;
    for (int k = 0; k < kAxes; ++k) {
      bits[k] = 0;
      while (bits[k] < kMostAxisBits && (e.high[k] - e.low[k]) > cell * float(1 << bits[k])) ++bits[k];
      total += bits[k];
    }
    return total;
  }
  vint key(const float* const* axes, int64_t first, int lanes) const {
    vint cells[kAxes], key = broadcast_int(0);
    for (int k = 0; k < kAxes; ++k) {
      const vfloat place = (load_first(axes[k] + first, lanes) - low[k]) * inverse_cell;
      cells[k] = truncate(clamp(place, 0.f, float((1 << bits[k]) - 1)));
    }
    for (int b = 0; b < used; ++b) key = key << 1 | (cells[from_axis[b]] >> int(from_bit[b]) & 1);
    return key;
  }
};

// Mean over packets of what their rays spread along all axes; order null: as they come.
double packet_spread(const float* const* axes, int64_t count, int packet_stride, const DepthKey* order) {
  double spread = 0.0;
  int64_t packets = 0;
  for (int64_t first = 0; first + kLanes <= count; first += int64_t(kLanes) * packet_stride, ++packets)
    for (int k = 0; k < kAxes; ++k) {
      vfloat values;
      if (order)
        for (int lane = 0; lane < kLanes; ++lane) values[lane] = axes[k][order[first + lane].id];
      else values = load(axes[k] + first);
      spread += largest(values) - smallest(values);
    }
  return packets ? spread / double(packets) : 0.0;
}

// Every kSampleStride-th ray, sorted: how wide would packets be if all were? Rays lie on a surface in the space of the
// axes, so that distances shrink with the root of their number.
bool worth_sorting(const RayOrderArgs& args, const float* const* axes, const MortonCells& cells) {
  const int64_t count = args.rays.count, sampled = count / kSampleStride;
  if (sampled < 2 * kLanes) return false;
  for (int64_t i = 0; i < sampled; ++i) {
    const float* shifted[kAxes];
    for (int k = 0; k < kAxes; ++k) shifted[k] = axes[k] + i * kSampleStride;
    args.spare[i] = {uint32_t(cells.key(shifted, 0, 1)[0]), uint32_t(i * kSampleStride)};
  }
  radix_sort(args.spare, args.keys, sampled, args.scratch, 1);
  const double sorted = packet_spread(axes, sampled, 1, args.keys) / __builtin_sqrt(double(kSampleStride));
  const double given = packet_spread(axes, count, kSampleStride / 2, nullptr);
  return given > kWorthSorting * sorted;
}

}  // namespace

// Writes args.order and returns true where the rays are to be sorted.
bool order_rays(const RayOrderArgs& args) {
  const TraceRays& rays = args.rays;
  if (rays.count <= kLanes) return false;
  float* axes[kAxes];
  for (int k = 0; k < kAxes; ++k) axes[k] = args.coordinates + k * rays.count;
  ray_coordinates(rays, tree_size(args.tree), axes, args.threads);
  const MortonCells cells(extent_of(axes, rays.count));
  if (!cells.used || (!args.always && !worth_sorting(args, axes, cells))) return false;
  each_block(args.threads, rays.count, kLanes, [&](int64_t first) {
    const int lanes = int(rays.count - first < kLanes ? rays.count - first : kLanes);
    const vint key = cells.key(axes, first, lanes);
    for (int lane = 0; lane < lanes; ++lane) args.spare[first + lane] = {uint32_t(key[lane]), uint32_t(first + lane)};
  });
  radix_sort(args.spare, args.keys, rays.count, args.scratch, args.threads);
  for (int64_t i = 0; i < rays.count; ++i) args.order[i] = int32_t(args.keys[i].id);
  return true;
}

int64_t order_scratch() { return int64_t(kMaxThreads) * kDigits; }

}  // namespace rtgs::RTGS_ISA
