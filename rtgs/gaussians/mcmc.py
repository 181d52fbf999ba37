"""Densification as Markov chain Monte Carlo: a fixed budget of Gaussians, and no thresholds on gradients.

Kheradmand et al. 2024, "3D Gaussian Splatting as Markov Chain Monte Carlo". Nearly transparent Gaussians move to where
opaque ones are, new ones appear there too until the budget is reached, and what shares a place is made fainter and
smaller so that the picture stays; noise lets the faint ones look around.
"""

from __future__ import annotations

import torch
from torch import Tensor

from rtgs.gaussians.adam import SurfelAdam
from rtgs.gaussians.density import DensityControl, DensityReport, RowPlan, apply_plan, select_rows
from rtgs.gaussians.primitives import Gaussians
from rtgs.gaussians.settings import DensitySettings

MOST_OPAQUE = 1 - 1e-6  # what counts as an opacity of 1: beyond, no number of copies is equal to it
SLIGHTEST_NOISE = 1e-4  # of full strength: fainter noise is left out


def density_control(settings: DensitySettings, extent: float) -> DensityControl:
    """The control that ``settings.strategy`` names; ``extent`` of the scene, world units."""
    return McmcControl(settings, extent) if settings.strategy == "mcmc" else DensityControl(settings, extent)


def shared_opacity(opacity: Tensor, copies: Tensor) -> Tensor:
    """Opacity of each of ``copies`` Gaussians at one place that together are as opaque as one of ``opacity``; all (N,).

    1 - (1 - o')^c = o: through the centre, where all are met at full strength, as much light passes as before.
    """
    return -torch.expm1(torch.log1p(-opacity.clamp_max(MOST_OPAQUE)) / copies)


def shared_shrink(opacity: Tensor, copies: Tensor) -> Tensor:
    """What the scales of the copies are multiplied with, so that they block as much light along a line as the one.

    On a line through the centre, c copies of opacity o' and deviation s' block 1 - (1 - o' G)^c, which is the sum over
    k = 1 .. c of C(c, k) (-1)^(k+1) (o' G)^k; its integral is sqrt(2 pi) s' times the sum of
    C(c, k) (-1)^(k+1) o'^k / sqrt(k). One of opacity o and deviation s blocks sqrt(2 pi) s o. (Equation 9 of the paper,
    its double sum summed over the first index.)

    Args:
        opacity: (N,) of the one Gaussian, in (0, 1).
        copies: (N,) integers of at least 1.

    Returns:
        (N,) s' / s, float64. Terms reach 1 / (1 - o), so float64 loses at most six of its digits.
    """
    one = opacity.double().clamp_max(MOST_OPAQUE)
    count = copies.double()
    log_shared = torch.log(shared_opacity(one, count))
    log_factorial = torch.lgamma(count + 1)
    total = torch.zeros_like(one)
    for k in range(1, (int(copies.max()) if len(copies) else 0) + 1):
        some = copies >= k
        c = count[some]
        binomial = log_factorial[some] - torch.lgamma(torch.full_like(c, k + 1)) - torch.lgamma(c - k + 1)
        total[some] += (-1) ** (k + 1) * torch.exp(binomial + k * log_shared[some]) / k**0.5
    return one / total


class McmcControl(DensityControl):
    """Relocation, growth and noise behind the interface of :class:`DensityControl`, whose cap is the budget."""

    needs_signal = False
    resets_opacity = False

    @torch.no_grad()
    def densify(
        self, surfels: Gaussians, optimizer: SurfelAdam, generator: torch.Generator, *, after_reset: bool = True
    ) -> DensityReport:
        """Move what is nearly transparent, and grow towards the budget.

        Places are drawn by opacity among the others. Whatever shares a place afterwards starts with zero moments. In
        the report, a Gaussian that moved counts as pruned here and cloned there.
        """
        opacity = surfels.opacity_logits.detach().sigmoid()
        keep = (opacity >= self.settings.mcmc.min_opacity).nonzero().flatten()
        if len(keep) > self.cap:
            keep = opacity.argsort(descending=True, stable=True)[: self.cap].sort().values
        pruned = len(surfels) - len(keep)
        target = min(int((1 + self.settings.mcmc.growth) * len(surfels)), self.cap)
        added = draw_copies(opacity[keep], target - len(keep), generator)
        source = keep[added > 0]
        self._share(surfels, source, 1 + added[added > 0])
        for name, _ in surfels.items():
            optimizer.zero_moments(name, source)
        plan = RowPlan(keep, select_rows(surfels, keep.repeat_interleave(added)))
        apply_plan(plan, surfels, optimizer, self)
        return DensityReport(cloned=len(plan.added), split=0, pruned=pruned, total=len(surfels))

    def _share(self, surfels: Gaussians, rows: Tensor, copies: Tensor) -> None:
        """Give ``rows`` the opacity and scales that each of ``copies`` equal Gaussians has at their place."""
        opacity = surfels.opacity_logits.detach()[rows].double().sigmoid()
        shared = shared_opacity(opacity, copies).clamp_min(self.settings.mcmc.min_opacity)  # not dead again at once
        surfels.opacity_logits[rows] = torch.logit(shared).float()
        surfels.log_scales[rows] += shared_shrink(opacity, copies).log().float()[:, None]

    @torch.no_grad()
    def perturb(self, surfels: Gaussians, means_rate: float, generator: torch.Generator) -> None:
        """Langevin noise on the means: covariance times standard normal, full strength only where nearly transparent.

        The covariance is taken in units of the scene extent, so that a scene in other units is trained alike.
        """
        mcmc = self.settings.mcmc
        strength = torch.sigmoid(mcmc.noise_sharpness * (mcmc.noise_border - surfels.opacity_logits.sigmoid()))
        rows = (strength > SLIGHTEST_NOISE).nonzero().flatten()
        normal = torch.randn(len(rows), 3, generator=generator)
        deviations = select_rows(surfels, rows).deviations() / self.extent
        along = (deviations * normal[:, None]).sum(dim=2, keepdim=True)  # covariance = sum of outer products
        noise = (along * deviations).sum(dim=1)
        surfels.means[rows] += means_rate * mcmc.noise * strength[rows, None] * noise


def draw_copies(opacity: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """(N,) int64: how often each of N Gaussians was drawn in ``count`` draws with replacement, by opacity."""
    if count <= 0 or not len(opacity):
        return torch.zeros(len(opacity), dtype=torch.int64)
    drawn = torch.searchsorted(
        opacity.double().cumsum(0), torch.rand(count, generator=generator, dtype=torch.float64) * opacity.double().sum()
    )
    return torch.bincount(drawn.clamp_max(len(opacity) - 1), minlength=len(opacity))
