// Weights of what traced pixels show of a thin wall of glass (wall.h), kLanes pixels at a time.
#include "image/wall_surface.h"

namespace rtgs::RTGS_ISA {
namespace {

constexpr float kSmallestShown = 1e-6f;  // of k_s, as a divisor

struct PixelGroup {  // of kLanes pixels
  vint edge;           // row at the outline, 0 where there is none
  vmask glass, edges;  // edges are glass, too
  Surface surface;
  vfloat walls, reflected, met, specular, share, beside, keep;  // met: the share of light that meets a wall
  Vector passing;                                               // one colour for all without a tint
  int colors;

  PixelGroup(const WallPixels& in, int64_t first, int lanes)
      : surface(load_first(in.cosine + first, lanes), in.glass.index), specular{}, share{}, beside{},
        keep(broadcast(1.f)), colors(in.glass.tinted ? 3 : 1) {
    const vint place = load_int(in.place + first);
    glass = gt_int(place, broadcast_int(kNoGlass)), edges = gt_int(place, broadcast_int(-1));
    edge = max_int(place, broadcast_int(0));
    walls = in.walls ? load_first(in.walls + first, lanes) : broadcast(1.f);
    reflected = select(glass, walls * surface.reflected(), load_first(in.reflection + first, lanes));
    met = walls;
    if (any(edges)) look_beside(in, first, lanes);
    for (int k = 0; k < colors; ++k) {
      const vfloat tinted = (1.f - met) + (met - reflected) * in.glass.tint[k];
      passing.v[k] = where(glass, in.glass.tinted ? tinted : 1.f - reflected);
    }
  }
  // q = (1 - a) / k_s, at most 1
  void look_beside(const WallPixels& in, int64_t first, int lanes) {
    reflected = select(edges, gather(in.edge_reflected, edge), reflected);
    met = select(edges, gather(in.edge_wall, edge), met);
    const vfloat low = broadcast(kSmallestShown), one = broadcast(1.f);
    specular = load_first(in.specular + first, lanes);
    share = (1.f - gather(in.edge_share, edge)) / select(lt(specular, low), low, specular);
    beside = where(edges, select(gt(share, one), one, share));
    keep = 1.f - beside;
  }
  vfloat beside_by_specular() const {
    const vmask slopes = edges & ge(specular, broadcast(kSmallestShown)) & le(share, broadcast(1.f));
    return where(slopes, -share / specular);
  }
};

}  // namespace

void wall_weights(const WallPixels& in, const WallPixelWeights& out) {
  each_block(worth(in.threads, in.count), in.count, kLanes, [&](int64_t first) {
    const int lanes = lanes_at(first, in.count);
    const PixelGroup pixels(in, first, lanes);
    store_first(out.reflection + first, pixels.reflected * pixels.keep, lanes);
    for (int k = 0; k < pixels.colors; ++k)
      store_first(out.passing + k * in.count + first, pixels.passing.v[k] * pixels.keep, lanes);
    if (out.beside) store_first(out.beside + first, pixels.beside, lanes);
  });
}

void wall_weights_backward(const WallPixels& in, const WallPixelUpstream& upstream, const WallPixelGradients& out) {
  for_blocks<kGlassNumbers>(worth(in.threads, in.count), in.count, out.glass,
                            [&](int64_t first, int lanes, vfloat* totals) {
    const PixelGroup pixels(in, first, lanes);
    const vfloat by_reflected = load_first(upstream.reflection + first, lanes);
    vfloat to_reflected = by_reflected * pixels.keep, to_beside{};
    if (upstream.beside) to_beside = load_first(upstream.beside + first, lanes) - by_reflected * pixels.reflected;
    for (int k = 0; k < pixels.colors; ++k) {
      const float tint = in.glass.tinted ? in.glass.tint[k] : 1.f;
      const vfloat by_passing = load_first(upstream.passing + k * in.count + first, lanes);
      const vfloat to_passing = where(pixels.glass, by_passing * pixels.keep);
      to_reflected -= to_passing * tint;
      totals[1 + k] += to_passing * (pixels.met - pixels.reflected);
      to_beside -= by_passing * pixels.passing.v[k];
    }
    store_first(out.reflection + first, where(mask_not(pixels.glass), to_reflected), lanes);
    const vmask centers = pixels.glass & mask_not(pixels.edges);  // those whose own cosine counts
    const vfloat to_wall = where(centers, to_reflected * pixels.walls);
    store_first(out.cosine + first, to_wall * pixels.surface.by_cosine(), lanes);
    totals[0] += where(centers, to_wall * pixels.surface.by_index());
    if (!out.specular) return;
    store_first(out.specular + first, where(pixels.edges, to_beside * pixels.beside_by_specular()), lanes);
    scatter(out.edge_reflected, pixels.edge, to_reflected, pixels.edges);
  });
}

}  // namespace rtgs::RTGS_ISA
