"""The surfel ray tracer on the native core: docs/tracer.md says what it computes, rtgs/native/trace_* and bvh_* how."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from rtgs.native import core
from rtgs.native.threads import threads
from rtgs.render.arguments import check_float32, check_trace_shapes, check_tree_shapes
from rtgs.render.buffers import TraceBuffers, TraceOptions

_DEFAULT_OPTIONS = TraceOptions()


class SurfelTree:
    """Bounding volume hierarchy over surfels, for :func:`trace_surfels`.

    ``build`` sorts the surfels anew; ``refit`` keeps the tree's shape and moves its boxes, which is many times faster
    but lets the tree age: ``surface_cost`` says how far. Results do not depend on which of the two was called, bit for
    bit. Both run on as many threads as :func:`rtgs.native.threads.threads` says.
    """

    def __init__(self) -> None:
        self._native = core.SurfelTree()
        self._alpha_cutoff = 0.0

    def build(
        self,
        means: Tensor,
        tangent_u: Tensor,
        tangent_v: Tensor,
        scales: Tensor,
        opacities: Tensor,
        *,
        alpha_cutoff: float = _DEFAULT_OPTIONS.alpha_cutoff,
    ) -> SurfelTree:
        """Make the tree of N surfels.

        Parameters
        ----------
        means, tangent_u, tangent_v, scales, opacities : Tensor
            N surfels, as for :func:`trace_surfels`.
        alpha_cutoff : float, optional
            Traces with a smaller one are refused, because their surfels reach further.

        Returns
        -------
        SurfelTree
            Itself.

        Raises
        ------
        ValueError
            A shape, a dtype or the cutoff does not fit.
        """
        arrays = _tree_arrays(means, tangent_u, tangent_v, scales, opacities, alpha_cutoff)
        self._native.build(*arrays, alpha_cutoff, threads())
        self._alpha_cutoff = alpha_cutoff
        return self

    def refit(
        self,
        means: Tensor,
        tangent_u: Tensor,
        tangent_v: Tensor,
        scales: Tensor,
        opacities: Tensor,
        *,
        alpha_cutoff: float = _DEFAULT_OPTIONS.alpha_cutoff,
    ) -> SurfelTree:
        """Fit the tree to surfels that moved.

        Parameters
        ----------
        means, tangent_u, tangent_v, scales, opacities : Tensor
            N surfels, as for :func:`trace_surfels`.
        alpha_cutoff : float, optional
            Traces with a smaller one are refused, because their surfels reach further.

        Returns
        -------
        SurfelTree
            Itself.

        Raises
        ------
        ValueError
            As ``build``; or the tree was built for another number of surfels.
        """
        arrays = _tree_arrays(means, tangent_u, tangent_v, scales, opacities, alpha_cutoff)
        if len(means) != self.surfels:
            raise ValueError(
                f"refit got {len(means)} surfels, the tree was built for {self.surfels}; build it again after surfels "
                "are added or removed"
            )
        self._native.refit(*arrays, alpha_cutoff, threads())
        self._alpha_cutoff = alpha_cutoff
        return self

    @property
    def surfels(self) -> int:
        """N of the last build; 0 before."""
        return self._native.surfels

    @property
    def nodes(self) -> int:
        """How many the tree has."""
        return self._native.nodes

    @property
    def surface_cost(self) -> float:
        """Expected boxes and surfels a ray meets, by surface area; grows as refits age the tree."""
        return self._native.surface_cost

    @property
    def alpha_cutoff(self) -> float:
        """What the boxes were made for; 0 before the first build."""
        return self._alpha_cutoff


def trace_surfels(
    means: Tensor,
    tangent_u: Tensor,
    tangent_v: Tensor,
    scales: Tensor,
    opacities: Tensor,
    origins: Tensor,
    directions: Tensor,
    *,
    tree: SurfelTree | None = None,
    features: Tensor | None = None,
    sh_dc: Tensor | None = None,
    sh_rest: Tensor | None = None,
    options: TraceOptions = _DEFAULT_OPTIONS,
    probe: Tensor | None = None,
) -> TraceBuffers:
    """Trace R rays through N surfels; :func:`rtgs.render.reference.trace.trace_surfels` is its float64 twin.

    Runs on as many threads as :func:`rtgs.native.threads.threads` says; no bit of the result depends on it. First
    derivatives only: a second backward pass through the gradients raises.

    Parameters
    ----------
    means : (N, 3) Tensor
        Centres, float32, world frame. N = 0 is legal.
    tangent_u, tangent_v : (N, 3) Tensor
        Orthonormal pairs, world; independent variables of the gradient.
    scales : (N, 2) Tensor
        Standard deviations along the tangents, world units.
    opacities : (N,) Tensor
        In (0, 1].
    origins, directions : (R, 3) Tensor
        Rays, world. Directions of any length; t is in units of it. R = 0 is legal.
    tree : SurfelTree, optional
        Built or refitted on exactly these means, tangents, scales and opacities; None builds one.
    features : (N, C) Tensor, optional
        What to accumulate, 1 <= C <= 32; None accumulates none.
    sh_dc, sh_rest : (N, 3) and (N, K, 3) Tensor, optional
        Colour in spherical harmonics, K = 0, 3, 8 or 15, evaluated at the unit ray direction.
    options : TraceOptions, optional
        Bounds, cuts, optional outputs, which directions and gradients, order of the rays in the kernel.
    probe : (N, 3) Tensor, optional
        Any values: its gradient receives the densification signal, the sum over hits of dL/dmean * 0.5 * t
        (method.md 3.2).

    Returns
    -------
    TraceBuffers
        What each ray met.

    Raises
    ------
    ValueError
        A shape, a dtype, an option or the tree does not fit; the message names the argument.

    References
    ----------
    .. [1] docs/tracer.md
    """
    surfels = _named(means, tangent_u, tangent_v, scales, opacities)
    check_trace_shapes(surfels, origins, directions, features, sh_dc, sh_rest, probe, options)
    others = {"origins": origins, "directions": directions, "features": features, "probe": probe}
    others |= {"sh_dc": sh_dc, "sh_rest": sh_rest, "t_min": options.t_min, "t_max": options.t_max}
    check_float32(surfels | {n: t for n, t in others.items() if isinstance(t, Tensor)}, "rtgs.render.reference.trace")
    tree = _fitting_tree(tree, surfels, options.alpha_cutoff)
    if sh_dc is not None and sh_rest is None:
        sh_rest = sh_dc.new_empty(len(sh_dc), 0, 3)

    def rows(tensor: Tensor | None) -> Tensor | None:
        return None if tensor is None else tensor.contiguous()

    call = _Call(tree, options, threads())
    inputs = (*surfels.values(), features, sh_dc, sh_rest, origins, directions)
    return TraceBuffers(*_Trace.apply(*(rows(tensor) for tensor in inputs), probe, call))


@dataclass(frozen=True)
class _Call:
    tree: SurfelTree
    options: TraceOptions
    threads: int

    def native_tracing(self):
        o = self.options
        last_sh = o.direction_gradient == "last_sh"
        raw_sh = o.sh_direction == "raw"
        return core.Tracing(o.transmittance_cutoff, o.alpha_cutoff, o.sh_degree, last_sh, raw_sh, o.order, self.threads)

    def bound(self, name: Literal["t_min", "t_max"]):
        """(array per ray or None, number that holds without one)."""
        value = getattr(self.options, name)
        return (_array(value.contiguous()), 0.0) if isinstance(value, Tensor) else (None, float(value))


def _array(tensor: Tensor | None):
    return None if tensor is None else tensor.detach().numpy()


def _empty(wanted: bool, *shape: int) -> Tensor | None:
    return torch.empty(shape, dtype=torch.float32) if wanted else None


class _Trace(torch.autograd.Function):
    """The tape of the forward pass lives in ``ctx.native`` and returns to a pool when autograd drops the context."""

    @staticmethod
    def forward(
        ctx, means, tangent_u, tangent_v, scales, opacities, features, sh_dc, sh_rest, origins, directions, probe, call
    ):
        options, rays = call.options, len(origins)
        inputs = (means, tangent_u, tangent_v, scales, opacities, features, sh_dc, sh_rest, origins, directions)
        colors = _empty(sh_dc is not None, rays, 3)
        mixed = None if features is None else _empty(True, rays, features.shape[1])
        alpha = torch.empty(rays, dtype=torch.float32)
        depth, normal = _empty(options.depth, rays), _empty(options.normal, rays, 3)
        weight_sum = _empty(options.weight_sum, len(means))
        (t_min_each, t_min), (t_max_each, t_max) = call.bound("t_min"), call.bound("t_max")
        keep = any(ctx.needs_input_grad)
        native = call.native_tracing()
        bounds = (t_min_each, t_max_each, t_min, t_max)
        outputs = (colors, mixed, alpha, depth, normal)
        arrays = [_array(t) for t in inputs]
        native.forward(call.tree._native, *arrays, *bounds, keep, *(_array(t) for t in (*outputs, weight_sum)))
        if keep:
            ctx.native = native
            ctx.save_for_backward(*inputs, *outputs)
            if weight_sum is not None:
                ctx.mark_non_differentiable(weight_sum)
            ctx.set_materialize_grads(False)
        return *outputs, weight_sum

    @staticmethod
    @once_differentiable
    def backward(ctx, *upstream):  # type: ignore[override]
        upstream = upstream[:5]  # not the weight sum's
        if all(g is None for g in upstream):
            return (None,) * 12
        saved = ctx.saved_tensors
        inputs = saved[:10]
        like = (*inputs, inputs[0])  # the probe's gradient is shaped as the means
        wanted = zip(like, ctx.needs_input_grad, strict=False)
        gradients = [_empty(needed, *t.shape) if t is not None else None for t, needed in wanted]
        ctx.native.backward(
            *(_array(t) for t in saved),
            *(None if g is None else _array(g.contiguous()) for g in upstream),
            *(_array(g) for g in gradients),
        )
        return (*gradients, None)


def _named(means: Tensor, tangent_u: Tensor, tangent_v: Tensor, scales: Tensor, opacities: Tensor) -> dict[str, Tensor]:
    named = {"means": means, "tangent_u": tangent_u, "tangent_v": tangent_v}
    return named | {"scales": scales, "opacities": opacities}


def _tree_arrays(
    means: Tensor, tangent_u: Tensor, tangent_v: Tensor, scales: Tensor, opacities: Tensor, alpha_cutoff: float
) -> list:
    surfels = _named(means, tangent_u, tangent_v, scales, opacities)
    check_tree_shapes(surfels, alpha_cutoff)
    check_float32(surfels, "rtgs.render.reference.trace")
    return [_array(tensor.contiguous()) for tensor in surfels.values()]


def _fitting_tree(tree: SurfelTree | None, surfels: dict[str, Tensor], alpha_cutoff: float) -> SurfelTree:
    count = len(surfels["means"])
    if tree is None:
        return SurfelTree().build(**surfels, alpha_cutoff=alpha_cutoff)
    if tree.surfels != count:
        raise ValueError(f"tree holds {tree.surfels} surfels, means {count}; build it on the surfels that are traced")
    if tree.alpha_cutoff > alpha_cutoff:
        raise ValueError(
            f"tree was built for alpha_cutoff={tree.alpha_cutoff:g}, the trace asks for {alpha_cutoff:g}: its boxes "
            "are too small; build or refit it with the smaller cutoff"
        )
    return tree
