"""PLY import and export of surfels and ellipsoids in the layout of 3DGS, which the common viewers open.

Float32 vertex properties: x y z nx ny nz f_dc_0..2 f_rest_0..3K-1 opacity scale_0 scale_1 [scale_2] rot_0..3. Values
are raw (logit of opacity, log of scales, quaternion w x y z of any length); f_rest is channel-major: all
coefficients of red, then green, then blue. Of other tools' files the same names are read, in any order, whatever else
they hold; PlayCanvas' compressed files are read with ``gsply``.
Channels follow, raw too, under the names of ``Channel.properties`` (materials: specular roughness f0_0..); viewers
ignore them. A comment ``SplatRenderMode: 2dgs`` or ``default`` says how Brush and SuperSplat draw them.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import plyfile
import torch
from torch import Tensor

from rtgs.core.errors import RtgsError
from rtgs.core.files import whole_file
from rtgs.core.ply_header import PlyHeaderError, PlySizeError, check_ply
from rtgs.gaussians.channels import Channel
from rtgs.gaussians.ellipsoids import Ellipsoids
from rtgs.gaussians.harmonics import rgb_to_sh_dc
from rtgs.gaussians.materials import stored_materials
from rtgs.gaussians.primitives import Gaussians, tangents
from rtgs.gaussians.surfels import Surfels

THIRD_LOG_SCALE = math.log(1e-6)  # what viewers get as the thickness of a surfel
THICKEST_LOG_SCALE = -10.0  # a third scale above this is no surfel's
COMMENT = "surfels (2D Gaussians): scale_0, scale_1 along columns 0, 1 of the rotation"
RENDER_MODES = {True: "SplatRenderMode: 2dgs", False: "SplatRenderMode: default"}  # a comment that viewers look for


def write_ply(path: str | Path, gaussians: Gaussians, third_scale: bool = True) -> None:
    """Write N surfels or ellipsoids, binary little-endian; an existing file is replaced in one step.

    Ellipsoids have their three scales and normals of 0, as 3DGS writes them.

    Parameters
    ----------
    path : str or Path
        The file.
    gaussians : Surfels or Ellipsoids
        With their channels.
    third_scale : bool, optional
        Of surfels: add the constant scale_2 = log(1e-6) that viewers of 3D Gaussians need; without it the file is the
        native two-scale one. :func:`read_gaussians` takes all of them and gives back the same bits.

    Raises
    ------
    ValueError
        A value is NaN or inf, or a channel has the name of another property.
    """
    path = Path(path)
    values = {name: tensor.detach() for name, tensor in gaussians.items()}
    for name, tensor in values.items():
        if bad := int((~torch.isfinite(tensor)).sum()):
            raise ValueError(f"{path} is not written: {bad} values of {name} are NaN or inf")
    flat = gaussians.axis_count == 2
    normals = torch.zeros_like(values["means"])
    if flat:
        normals = torch.linalg.cross(*tangents(values["quaternions"]), dim=1)
    columns: dict[str, Tensor] = {}
    _add(columns, ("x", "y", "z"), values["means"])
    _add(columns, ("nx", "ny", "nz"), normals)
    _add(columns, _numbered("f_dc", 3), values["sh_dc"])
    rest = values["sh_rest"].transpose(1, 2).flatten(1)
    _add(columns, _numbered("f_rest", rest.shape[1]), rest)
    columns["opacity"] = values["opacity_logits"]
    _add(columns, _numbered("scale", gaussians.axis_count), values["log_scales"])
    if flat and third_scale:
        columns["scale_2"] = torch.full((len(gaussians),), THIRD_LOG_SCALE)
    _add(columns, _numbered("rot", 4), values["quaternions"])
    for channel in gaussians.channels:
        if taken := [name for name in channel.properties if name in columns]:
            raise ValueError(f"{path} is not written: channel {channel.name} would be property {taken[0]}, as another")
        _add(columns, channel.properties, values[channel.name].reshape(len(gaussians), channel.columns))

    vertices = np.empty(len(gaussians), dtype=[(name, "<f4") for name in columns])
    for name, column in columns.items():
        vertices[name] = column.numpy()
    element = plyfile.PlyElement.describe(vertices, "vertex")
    comments = [*([COMMENT] if flat else []), RENDER_MODES[flat]]
    with whole_file(path) as partial:
        plyfile.PlyData([element], text=False, byte_order="<", comments=comments).write(str(partial))


def read_ply(path: str | Path, *, channels: tuple[Channel, ...] | None = None) -> Surfels:
    """Read surfels from a file of :func:`write_ply`, of 2DGS or of another tool with this layout (text or binary).

    Args:
        channels: as of :func:`read_gaussians`.

    Raises:
        FileNotFoundError: there is no such file.
        RtgsError: as :func:`read_gaussians`, or the Gaussians are not flat.
    """
    gaussians = read_gaussians(path, channels=channels)
    if not isinstance(gaussians, Surfels):
        thick = int((gaussians.log_scales[:, 2] > THICKEST_LOG_SCALE).sum())
        raise RtgsError(
            f"{path}: {thick} of {len(gaussians)} Gaussians have a third scale (log > {THICKEST_LOG_SCALE:g}), "
            "so they are 3D Gaussians, not surfels; convert them first"
        )
    return gaussians


def read_gaussians(
    path: str | Path, *, skip_broken: bool = False, channels: tuple[Channel, ...] | None = None
) -> Surfels | Ellipsoids:
    """Read any Gaussian splat in the layout of 3DGS: text or binary, plain or compressed, SH of degree 0 to 3.

    Properties may come in any order; those without a meaning here, the normals among them, are ignored.

    Parameters
    ----------
    path : str or Path
        The file.
    skip_broken : bool, optional
        Leave out Gaussians with a NaN or inf instead of refusing the file.
    channels : tuple of Channel, optional
        Those to read; the file holds raw values, but not what they mean. None: materials where it has them, with the
        activations of default settings.

    Returns
    -------
    Surfels or Ellipsoids
        Surfels where there is no third scale, or all third scales are below exp(-10) world units; else ellipsoids.
        Float32, without gradient.

    Raises
    ------
    FileNotFoundError
        There is no such file.
    RtgsError
        Not a PLY, truncated, a property is missing, NaN or inf, or ``gsply`` is needed and not installed.
    """
    path = Path(path)
    vertices = _read_vertices(path)
    names = [p.name for p in vertices.properties if not isinstance(p, plyfile.PlyListProperty)]
    if "packed_position" in names:
        gaussians = _read_compressed(path)
        if channels:
            raise RtgsError(f"{path} is a compressed splat: it has no channel {channels[0].name}")
    else:
        gaussians = _gaussians_of(path, vertices, names, stored_materials(names) if channels is None else channels)
    return _without_broken(path, gaussians, skip_broken)


def _gaussians_of(
    path: Path, vertices: plyfile.PlyElement, names: list[str], channels: tuple[Channel, ...]
) -> Surfels | Ellipsoids:
    """The raw parameters of a plain file, and its channels."""
    rest_count = sum(name.startswith("f_rest_") for name in names)
    if rest_count not in (0, 9, 24, 45):
        raise RtgsError(f"{path}: {rest_count} properties f_rest_*; SH of degree 0, 1, 2, 3 has 0, 9, 24, 45")

    def columns(*wanted: str) -> Tensor:
        if missing := [name for name in wanted if name not in names]:
            has = f"it has {', '.join(names) or 'none'}"
            plain = "; a plain point cloud holds no Gaussians" if {"x", "red"} <= set(names) else ""
            raise RtgsError(f"{path}: property {', '.join(missing)} missing; {has}{plain}")
        out = np.empty((vertices.count, len(wanted)), np.float32)
        with np.errstate(over="ignore"):  # doubles beyond float32 become inf, which is refused with the others
            for k, name in enumerate(wanted):
                out[:, k] = vertices[name]
        return torch.from_numpy(out)

    kind = Surfels
    if "scale_2" in names and bool((~(columns("scale_2") <= THICKEST_LOG_SCALE)).any()):
        kind = Ellipsoids
    rest = columns(*_numbered("f_rest", rest_count)).reshape(vertices.count, 3, rest_count // 3)
    if not rest_count and "f_dc_0" not in names and {"red", "green", "blue", "scale_0"} <= set(names):
        sh_dc = rgb_to_sh_dc(columns("red", "green", "blue") / 255)  # nerfstudio's export with ply_color_mode=rgb
    else:
        sh_dc = columns(*_numbered("f_dc", 3))
    return kind(
        means=columns("x", "y", "z"),
        log_scales=columns(*_numbered("scale", kind.axis_count)),
        quaternions=columns(*_numbered("rot", 4)),
        opacity_logits=columns("opacity").flatten(),
        sh_dc=sh_dc,
        sh_rest=rest.transpose(1, 2).contiguous(),
        channels=channels,
        raw={c.name: columns(*c.properties).reshape(vertices.count, *c.shape) for c in channels},
    )


def _read_compressed(path: Path) -> Ellipsoids:
    """PlayCanvas' packed layout, unpacked by ``gsply``."""
    try:
        import gsply  # pyright: ignore[reportMissingImports]  (an extra)
    except ImportError as error:
        raise RtgsError(
            f"{path} is a compressed splat: `pip install -e '.[compressed]'` in the clone of rtgs (the package gsply) "
            "reads it, or `splat-transform in.compressed.ply out.ply` makes a plain one of it"
        ) from error
    try:
        data = gsply.plyread(str(path))
    except (ValueError, IndexError, KeyError, OSError) as error:
        raise RtgsError(f"{path} is a compressed splat that gsply cannot read: {error}") from error

    def rows(values: np.ndarray | None, *shape: int) -> Tensor:
        return torch.from_numpy(np.array(values, dtype=np.float32)).reshape(len(data.means), *shape)

    rest = np.empty((len(data.means), 0, 3), np.float32) if data.shN is None else data.shN
    return Ellipsoids(
        means=rows(data.means, 3),
        log_scales=rows(data.scales, 3),
        quaternions=rows(data.quats, 4),
        opacity_logits=rows(data.opacities),
        sh_dc=rows(data.sh0, 3),
        sh_rest=rows(rest, rest.shape[1], 3),
    )


def _without_broken(path: Path, gaussians: Surfels | Ellipsoids, skip_broken: bool) -> Surfels | Ellipsoids:
    """The Gaussians without NaN and inf, or an error that names the first."""
    finite = torch.ones(len(gaussians), dtype=torch.bool)
    where = []
    for name, values in gaussians.items():
        sound = torch.isfinite(values).flatten(1).all(dim=1) if values.ndim > 1 else torch.isfinite(values)
        where += [] if bool(sound.all()) else [name]
        finite &= sound
    if bool(finite.all()):
        return gaussians
    bad = (~finite).nonzero().flatten().tolist()
    if not skip_broken:
        raise RtgsError(
            f"{path}: NaN or inf in {', '.join(where)} of {len(bad)} of {len(gaussians)} vertices, the first {bad[0]}; "
            "skip_broken (--skip-broken) leaves them out"
        )
    return gaussians.like({name: values[finite] for name, values in gaussians.items()})


def _add(columns: dict[str, Tensor], names: tuple[str, ...], values: Tensor) -> None:
    columns.update(zip(names, values.unbind(1), strict=True))


def _numbered(prefix: str, count: int) -> tuple[str, ...]:
    return tuple(f"{prefix}_{k}" for k in range(count))


def _read_vertices(path: Path) -> plyfile.PlyElement:
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        check_ply(path)
        with np.errstate(over="ignore"):  # numbers in text beyond their type become inf, which is refused
            ply = plyfile.PlyData.read(str(path))
    except PlySizeError as error:
        raise RtgsError(f"{path} is damaged or truncated: {error}") from error
    except (PlyHeaderError, plyfile.PlyHeaderParseError, UnicodeDecodeError) as error:
        raise RtgsError(f"{path} is not a PLY file: {error}") from error
    except (plyfile.PlyParseError, ValueError, MemoryError, OverflowError, OSError) as error:
        raise RtgsError(f"{path} is damaged or truncated: {error}") from error
    if "vertex" not in ply:
        raise RtgsError(f"{path}: no element 'vertex'; it has {', '.join(e.name for e in ply.elements) or 'none'}")
    return ply["vertex"]
