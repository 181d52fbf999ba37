// Tracing, a packet of rays at a time (docs/tracer.md). Pending children of the tree wait ordered by the smallest t
// at which a ray of the packet enters them; hits found are kept per lane. A hit nearer than the next pending child is
// final.
// Hits of a lane are composited in the order of (t, surfel id), and per-ray sums over surfels run by ascending id, so
// nothing depends on the shape of the tree.
#include "common/parallel.h"
#include "trace/sort.h"
#include "trace/traverse.h"

namespace rtgs::RTGS_ISA {
namespace {

constexpr int kSortAt = 16;  // rows of waiting hits that are worth sorting

class PacketTracer {
 public:
  PacketTracer(const TraceForwardArgs& args, TraceWorkspace& work, int64_t packet)
      : args_(args), work_(work), rays_(args.rays, packet), slabs_(rays_), t_max_(rays_.t_max),
        active_(rays_.usable) {}

  void run();
  void write(PacketTape* tape, TapeArena* arena);
  int64_t hits() const { return hits_; }

 private:
  void visit_node(int32_t index);
  void visit_leaf(int32_t child);
  uint64_t near_surfels(int32_t first, int32_t count) const;
  void wait(PendingChild entry);
  // Composites the waiting hits with t < before, lane by lane in their order.
  void settle(float before);
  void load_waiting(int rows);
  void order_ties(int rows);
  void composite_row(int row, vmask hit, vfloat t);
  void keep_rest(vint settled, int rows);

  void list_surfels();
  void sort_long_keys(int used);
  void write_channels();
  template <int B, bool kHitsOnly = false>
  void sum_channels(int first);
  void write_colors();
  void write_normal();
  void write_tape(PacketTape& tape, TapeArena& arena);

  void prefetch_leaf(int32_t first) const {
    const SlotBoxes& boxes = args_.boxes[first / kSlotsPerBlock];
    for (int line = 0; line < 3; ++line) __builtin_prefetch(reinterpret_cast<const char*>(&boxes) + 64 * line);
    __builtin_prefetch(record(first));
  }
  const float* record(int32_t slot) const { return args_.records + int64_t(kTraceFields) * slot; }

  const TraceForwardArgs& args_;
  TraceWorkspace& work_;
  const PacketRays rays_;
  const PacketSlabs slabs_;
  vfloat t_max_, transmittance_ = broadcast(1.f), depth_ = broadcast(0.f);
  vmask active_;
  vint waiting_ = broadcast_int(0);  // hits per lane
  int most_waiting_ = 0;             // no lane has more
  int pending_ = 0, places_ = 0, rows_ = 0, met_ = 0, sort_at_ = kSortAt;
  int64_t hits_ = 0;
};

// ---- traversal -------------------------------------------------------------------------------------------------
inline void PacketTracer::wait(PendingChild entry) {  // nearest last
  PendingChild* list = work_.pending.data;
  int place = pending_++;
  for (; place > 0 && list[place - 1].nearest < entry.nearest; --place) list[place] = list[place - 1];
  list[place] = entry;
}

inline void PacketTracer::visit_node(int32_t index) {
  const TreeNode& node = args_.tree.nodes[index];
  work_.pending.reserve(pending_ + kNodeChildren);
  for (uint32_t children = slabs_.may_meet(node); children; children &= children - 1) {
    const int k = __builtin_ctz(children);
    vfloat nearest;
    const vmask met = slabs_.meet(node, k, t_max_, nearest);
    if (!any(met)) continue;
    const int32_t child = node.child[k];
    if (child >= 0) __builtin_prefetch(&args_.tree.nodes[child]);
    else prefetch_leaf(leaf_first(child));
    wait({smallest(select(met, nearest, broadcast(kFarAway))), child, mask_bits(met)});
  }
}

// Of the slots from `first` on, those, as bits, whose surfels the box of all the rays may meet.
inline uint64_t PacketTracer::near_surfels(int32_t first, int32_t count) const {
  const int32_t skipped = first % kSlotsPerBlock;
  const SlotBoxes* boxes = args_.boxes + first / kSlotsPerBlock;
  uint64_t near = slabs_.may_meet(boxes->low, boxes->high);
  for (int32_t k = kSlotsPerBlock; k < skipped + count; k += kSlotsPerBlock) {
    ++boxes;
    near |= uint64_t(slabs_.may_meet(boxes->low, boxes->high)) << k;
  }
  return near >> skipped & ((uint64_t(1) << count) - 1);
}

inline void PacketTracer::visit_leaf(int32_t child) {
  const int32_t first = leaf_first(child), count = leaf_count(child);
  const int64_t floats = (places_ + count) * int64_t(kLanes);
  work_.t.reserve(floats);
  work_.exponents.reserve(floats);
  work_.weights.reserve(floats);
  work_.slots.reserve(places_ + count);
  work_.columns.reserve((most_waiting_ + count + 1) * int64_t(kLanes));
  // Locals: a store through a vector may alias any member.
  float *t = work_.t.data, *exponents = work_.exponents.data, *weights = work_.weights.data;
  int32_t *slots = work_.slots.data, *columns = work_.columns.data;
  const vfloat t_max = t_max_;
  uint32_t lanes[kMostPerLeaf];
  int found = 0;  // without a branch: a wrong guess costs as much as several tests
  for (uint64_t near = near_surfels(first, count); near; near &= near - 1) {
    const int32_t slot = first + __builtin_ctzll(near);
    const float* s = record(slot);
    const PlaneHit hit = plane_hit(s, rays_);
    const vmask counts = le(hit.rho, broadcast(s[kTraceReach])) & gt(hit.t, rays_.t_min) & lt(hit.t, t_max) &
                         ge(abs(hit.cosine), rays_.least_cosine);
    const int64_t at = int64_t(places_ + found) * kLanes;
    store(t + at, hit.t);
    store(exponents + at, response_exponent(s, hit.rho));
    slots[places_ + found] = slot;
    lanes[found] = mask_bits(counts);
    found += lanes[found] != 0;
  }
  const vint lane = truncate(lane_numbers());
  for (int k = 0; k < found; ++k) {
    const vmask counts = lanes_from_bits(lanes[k]);
    store(weights + int64_t(places_) * kLanes, broadcast(0.f));
    scatter_int(columns, waiting_ * kLanes + lane, broadcast_int(places_++), counts);
    waiting_ += select_int(counts, broadcast_int(1), broadcast_int(0));
  }
  most_waiting_ += found;
}

void PacketTracer::run() {
  work_.pending.reserve(kNodeChildren);
  work_.pending[0] = {-kFarAway, 0, mask_bits(active_)};
  pending_ = 1;
  while (pending_) {
    const PendingChild next = work_.pending[--pending_];
    if (most_waiting_ >= sort_at_ && any(gt_int(waiting_, broadcast_int(sort_at_ - 1)))) {
      settle(next.nearest);
      if (!any(active_)) break;
    }
    if (!(next.lanes & mask_bits(active_))) continue;
    if (next.child >= 0) visit_node(next.child);
    else if (next.child != kNoChild) visit_leaf(next.child);
  }
  if (any(active_)) settle(kFarAway);
}

// ---- compositing -----------------------------------------------------------------------------------------------
void PacketTracer::settle(float before) {
  const int rows = int(largest(to_float(waiting_)));
  if (rows == 0) return;
  work_.sorted_t.reserve((rows + 1) * kLanes);
  work_.sorted_places.reserve((rows + 1) * kLanes);
  work_.rows.reserve(int64_t(rows_ + rows) * kLanes);
  load_waiting(rows);
  sort_rows(work_.sorted_t.data, work_.sorted_places.data, rows);
  order_ties(rows);
  vint settled = broadcast_int(0);
  for (int row = 0; row < rows; ++row) {
    const vfloat t = load(work_.sorted_t.data + row * kLanes);
    const vmask hit = lt(t, broadcast(before)) & active_;
    if (!any(hit)) break;
    composite_row(row, hit, t);
    settled += select_int(hit, broadcast_int(1), broadcast_int(0));
  }
  t_max_ = select(active_, t_max_, broadcast(-kFarAway));
  keep_rest(settled, rows);
}

inline void PacketTracer::load_waiting(int rows) {
  const vint lane = truncate(lane_numbers());
  for (int row = 0; row < rows; ++row) {
    const vmask filled = gt_int(waiting_, broadcast_int(row));
    const vint place = select_int(filled, load_int(work_.columns.data + row * kLanes), broadcast_int(0));
    const vfloat t = select(filled, gather(work_.t.data, place * kLanes + lane), broadcast(kFarAway));
    store(work_.sorted_t.data + row * kLanes, t);
    store_ints(work_.sorted_places.data + row * kLanes, place);
  }
}

// Runs of equal t within a lane, put in the order of the surfels' ids. Copies that density control made are such runs.
inline void PacketTracer::order_ties(int rows) {
  for (int row = 0; row + 1 < rows; ++row) {
    const vfloat t = load(work_.sorted_t.data + row * kLanes), next = load(work_.sorted_t.data + (row + 1) * kLanes);
    for (uint32_t lanes = mask_bits(eq(t, next) & lt(t, broadcast(kFarAway))); lanes; lanes &= lanes - 1) {
      const int lane = __builtin_ctz(lanes);
      int32_t* places = work_.sorted_places.data + lane;
      const int32_t place = places[(row + 1) * kLanes], id = record_id(record(work_.slots[place]));
      int to = row + 1;
      for (; to > 0 && work_.sorted_t.data[(to - 1) * kLanes + lane] == t[lane] &&
             record_id(record(work_.slots[places[(to - 1) * kLanes]])) > id; --to)
        places[to * kLanes] = places[(to - 1) * kLanes];
      places[to * kLanes] = place;
    }
  }
}

inline void PacketTracer::composite_row(int row, vmask hit, vfloat t) {
  const vint place = load_int(work_.sorted_places.data + row * kLanes);
  const vint at = place * kLanes + truncate(lane_numbers());
  const vfloat alpha = min(exp2_response(gather(work_.exponents.data, at)), broadcast(kMaxAlpha));
  const vfloat w = where(hit, alpha * transmittance_);
  depth_ += w * where(hit, t);
  transmittance_ -= w;
  scatter(work_.weights.data, at, w, hit);
  store_ints(work_.rows.data + int64_t(rows_++) * kLanes, select_int(hit, place, broadcast_int(-1)));
  hits_ += __builtin_popcount(mask_bits(hit));
  active_ = active_ & gt(transmittance_, broadcast(args_.options.transmittance_cutoff));
}

// Moves what was not composited to the front of its column, and forgets the hits of lanes that stopped.
inline void PacketTracer::keep_rest(vint settled, int rows) {
  const vint lane = truncate(lane_numbers());
  waiting_ = select_int(active_, waiting_ - settled, broadcast_int(0));
  const int left = int(largest(to_float(waiting_)));
  most_waiting_ = left;
  for (int row = 0; row < left; ++row) {
    const vint from = min_int(settled + row, broadcast_int(rows - 1));
    store_ints(work_.columns.data + row * kLanes, gather_int(work_.sorted_places.data, from * kLanes + lane));
  }
  sort_at_ = left + left / 2 > kSortAt ? left + left / 2 : kSortAt;
}

// ---- the surfels met, and the sums over them -------------------------------------------------------------------
// Slots and places of the surfels with a weight, by ascending surfel id.
inline void PacketTracer::list_surfels() {
  work_.keys.reserve(padded_count(places_) + kLanes);
  work_.met_ids.reserve(places_);
  work_.met_slots.reserve(places_);
  work_.met_places.reserve(places_);
  int place_bits = 1;
  while (places_ >> place_bits) ++place_bits;
  const bool compact = (args_.tree.surfels >> (31 - place_bits)) == 0;  // id and place fit one int
  if (!compact) work_.long_keys.reserve(places_), work_.spare_keys.reserve(places_);
  const vfloat zero = broadcast(0.f);
  int used = 0;
  for (int place = 0; place < places_; ++place) {
    const int32_t id = record_id(record(work_.slots[place]));
    if (compact) work_.keys[used] = id << place_bits | place;
    else work_.long_keys[used] = uint64_t(id) << 32 | uint32_t(place);
    const bool met = any(gt(load(work_.weights.data + int64_t(place) * kLanes), zero));
    if (met) prefetch_surfel(args_.surfels, id);
    used += met;
  }
  if (compact) sort_ints(work_.keys.data, used);
  else sort_long_keys(used);
  for (int k = 0; k < used; ++k) {
    const int32_t place = compact ? work_.keys[k] & ((1 << place_bits) - 1) : int32_t(uint32_t(work_.long_keys[k]));
    work_.met_places[k] = place;
    work_.met_slots[k] = work_.slots[place];
    work_.met_ids[k] = compact ? work_.keys[k] >> place_bits : int32_t(work_.long_keys[k] >> 32);
  }
  met_ = used;
}

void PacketTracer::sort_long_keys(int used) {  // merge sort
  uint64_t *from = work_.long_keys.data, *to = work_.spare_keys.data;
  for (int run = 1; run < used; run *= 2) {
    for (int base = 0; base < used; base += 2 * run) {
      int a = base, b = base + run < used ? base + run : used, k = base;
      const int a_end = b, b_end = base + 2 * run < used ? base + 2 * run : used;
      while (a < a_end && b < b_end) to[k++] = from[a] < from[b] ? from[a++] : from[b++];
      while (a < a_end) to[k++] = from[a++];
      while (b < b_end) to[k++] = from[b++];
    }
    uint64_t* swap = from;
    from = to, to = swap;
  }
  if (from != work_.long_keys.data) memcpy(work_.long_keys.data, from, size_t(used) * sizeof(uint64_t));
}

inline void store_component(float* out, int stride, const PacketRays& rays, vfloat v) {
  scatter(out, rays.ray * stride, v, rays.exists);
}

// B features from `first` on. A feature that is not finite would reach rays with weight 0, too: then hits only.
template <int B, bool kHitsOnly>
inline void PacketTracer::sum_channels(int first) {
  const int channels = args_.surfels.feature_count();
  vfloat sums[B];
  for (int c = 0; c < B; ++c) sums[c] = broadcast(0.f);
  for (int k = 0; k < met_; ++k) {
    const float* row = args_.surfels.arrays.features + int64_t(channels) * work_.met_ids[k] + first;
    const vfloat w = load(work_.weights.data + int64_t(work_.met_places[k]) * kLanes);
#pragma GCC unroll 16
    for (int c = 0; c < B; ++c)
      sums[c] = fma(w, kHitsOnly ? where(gt(w, broadcast(0.f)), broadcast(row[c])) : broadcast(row[c]), sums[c]);
  }
  if constexpr (!kHitsOnly)
    for (int c = 0; c < B; ++c)
      if (any(mask_not(finite(sums[c])))) return sum_channels<B, true>(first);
  for (int c = 0; c < B; ++c) store_component(args_.features + first + c, channels, rays_, sums[c]);
}

inline void PacketTracer::write_channels() {
  const int channels = args_.surfels.feature_count();
  int first = 0;
  for (; first + 12 <= channels; first += 12) sum_channels<12>(first);
  for (; first + 4 <= channels; first += 4) sum_channels<4>(first);
  for (; first < channels; ++first) sum_channels<1>(first);
}

inline void PacketTracer::write_colors() {
  vfloat basis[16], raw[3], sums[3] = {broadcast(0.f), broadcast(0.f), broadcast(0.f)};
  packet_basis(args_.surfels.degree, rays_.color_direction(args_.options.raw_sh), basis);
  const int rest = rest_count(args_.surfels.degree);
  for (int k = 0; k < met_; ++k) {
    const vfloat w = load(work_.weights.data + int64_t(work_.met_places[k]) * kLanes);
    surfel_colors(args_.surfels, work_.met_ids[k], rest, basis, raw);
    const vmask met = gt(w, broadcast(0.f));
    for (int c = 0; c < 3; ++c) sums[c] += where(met, w * max(raw[c], broadcast(0.f)));
  }
  for (int c = 0; c < 3; ++c) store_component(args_.colors + c, 3, rays_, sums[c]);
}

inline void PacketTracer::write_normal() {
  vfloat sums[3] = {broadcast(0.f), broadcast(0.f), broadcast(0.f)};
  for (int k = 0; k < met_; ++k) {
    const float* n = record(work_.met_slots[k]) + kTraceNormal;
    const vfloat w = load(work_.weights.data + int64_t(work_.met_places[k]) * kLanes);
    const vfloat cosine = fma(rays_.dz, broadcast(n[2]), fma(rays_.dy, broadcast(n[1]), rays_.dx * n[0]));
    const vfloat facing = negated_where(gt(cosine, broadcast(0.f)), w);
    for (int c = 0; c < 3; ++c) sums[c] = fma(facing, broadcast(n[c]), sums[c]);
  }
  for (int c = 0; c < 3; ++c) store_component(args_.normal + c, 3, rays_, sums[c]);
}

void PacketTracer::write_tape(PacketTape& tape, TapeArena& arena) {
  const bool wide = places_ >= 0xffff;
  const int64_t row_values = int64_t(rows_) * kLanes;
  int32_t* ids = reinterpret_cast<int32_t*>(arena_take(arena, met_ * sizeof(int32_t)));
  int32_t* slots = reinterpret_cast<int32_t*>(arena_take(arena, met_ * sizeof(int32_t)));
  int32_t* places = reinterpret_cast<int32_t*>(arena_take(arena, met_ * sizeof(int32_t)));
  float* weights = reinterpret_cast<float*>(arena_take(arena, met_ * sizeof(float)));
  if (met_) {  // else the workspace may own no memory yet
    memcpy(ids, work_.met_ids.data, met_ * sizeof(int32_t));
    memcpy(slots, work_.met_slots.data, met_ * sizeof(int32_t));
    memcpy(places, work_.met_places.data, met_ * sizeof(int32_t));
  }
  for (int k = 0; k < met_; ++k) weights[k] = sum(load(work_.weights.data + int64_t(places[k]) * kLanes));
  char* rows = arena_take(arena, row_values * (wide ? sizeof(int32_t) : sizeof(uint16_t)));
  for (int64_t i = 0; i < row_values; i += kLanes) {
    const vint row = load_int(work_.rows.data + i);
    if (wide) store_ints(reinterpret_cast<int32_t*>(rows) + i, row);
    else store_short(reinterpret_cast<uint16_t*>(rows) + i, row);
  }
  tape = {ids, slots, places, weights, rows, met_, rows_, places_, int32_t(hits_), wide};
}

void PacketTracer::write(PacketTape* tape, TapeArena* arena) {
  list_surfels();
  store_component(args_.alpha, 1, rays_, 1.f - transmittance_);
  if (args_.depth) store_component(args_.depth, 1, rays_, depth_);
  if (args_.features) write_channels();
  if (args_.colors) write_colors();
  if (args_.normal) write_normal();
  if (tape) write_tape(*tape, *arena);
}

}  // namespace

int packet_lanes() { return kLanes; }

void trace_forward(TraceForwardArgs& args) {
  const int64_t packets = packet_count(args.rays);
  int64_t hits = 0;
  in_turns(args.options.threads, packets, 16, [&](int part, Turns& turns) {
    int64_t found = 0;
    for (int64_t packet, end; turns.next(packet, end);)
      for (; packet < end; ++packet) {
        PacketTracer tracer(args, workspace_of(args.workspaces, part), packet);
        tracer.run();
        tracer.write(args.tapes ? args.tapes + packet : nullptr, args.arenas + part);
        found += tracer.hits();
      }
    __atomic_fetch_add(&hits, found, __ATOMIC_RELAXED);
  });
  args.hits = hits;
}

// Adds in the order of packets, each thread for its share of the surfels.
void sum_packet_weights(const TraceForwardArgs& args, float* weight_sum) {
  const int threads = args.options.threads;
  const int64_t packets = packet_count(args.rays), count = args.tree.surfels;
  in_parts(threads, [&](int part) {
    const int64_t begin = count * part / threads, end = count * (part + 1) / threads;
    memset(weight_sum + begin, 0, size_t(end - begin) * sizeof(float));
    for (int64_t packet = 0; packet < packets; ++packet) {
      const PacketTape& tape = args.tapes[packet];
      for (int32_t k = 0; k < tape.surfels; ++k) {
        const int32_t id = tape.ids[k];
        if (id >= begin && id < end) weight_sum[id] += tape.weights[k];
      }
    }
  });
}

void free_trace_workspace(void* workspace) {
  if (!workspace) return;
  static_cast<TraceWorkspace*>(workspace)->release();
  free(workspace);
}

}  // namespace rtgs::RTGS_ISA
