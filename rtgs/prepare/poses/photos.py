"""The photos of a folder without poses: found, looked at, and laid out upright for the search of poses."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from rtgs.core.names import path_inside
from rtgs.prepare.errors import PrepareError
from rtgs.scenes.capture import Finding, existing_side_file, list_some
from rtgs.scenes.digest import content_hash
from rtgs.scenes.exif import EXIF_ERRORS, ORIENTATION, read_exif
from rtgs.scenes.images import (
    IMAGE_SUFFIXES,
    MASK_SUFFIXES,
    READ_ERRORS,
    nearest_resize,
    open_picture,
    read_mask,
    read_photo,
    refuse_pixels,
    same_aspect,
    turned_upright,
)
from rtgs.scenes.importers.colmap import IMAGE_FOLDERS
from rtgs.scenes.settings import CaptureError

HEIC_SUFFIXES = (".heic", ".heif")
RAW_SUFFIXES = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2")
VIDEO_SUFFIXES = (".mp4", ".mov", ".mkv", ".avi", ".webm", ".m4v")
_PLAIN = (".jpg", ".jpeg", ".png")  # read by COLMAP as they are
_JPEG_QUALITY = 97  # of photos that must be written anew: turned, HEIC, TIFF ...


@dataclass(frozen=True)
class Photo:
    """One photo as its header describes it, upright."""

    path: Path
    name: str  # relative to the photo folder, as the model will call it
    width: int  # pixels after EXIF orientation is applied
    height: int
    turned: bool  # stored on its side, EXIF says so
    camera: str  # make, model and focal length from EXIF; empty: unknown

    @property
    def group(self) -> tuple[int, int, str]:
        """Photos that share it share one lens."""
        return self.width, self.height, self.camera


@dataclass(frozen=True)
class PhotoSet:
    """The usable photos of a capture in name order, and what there was to say about the others."""

    root: Path
    folder: Path
    photos: tuple[Photo, ...]
    findings: tuple[Finding, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """The names, in order."""
        return tuple(photo.name for photo in self.photos)


def find_photo_folder(root: Path, images_dir: str | None = None) -> Path | None:
    """Where the photos lie: the named folder, the first of ``images``, ``input``, ``rgb``, ``image`` with photos in it,
    or ``root`` itself; None where there are none.

    Raises:
        PrepareError: the named folder does not exist.
    """
    if images_dir is not None:
        if not (root / images_dir).is_dir():
            raise PrepareError(f"images folder {root / images_dir} does not exist: correct scene.images_dir")
        return root / images_dir
    for name in (*IMAGE_FOLDERS, "."):
        folder = root / name
        if folder.is_dir() and next(photo_files(folder, recursive=name != "."), None) is not None:
            return root if name == "." else folder
    return None


def photo_files(folder: Path, recursive: bool) -> Iterator[Path]:
    """Image files in name order, sub-folders included; hidden ones (``._IMG_1.JPG`` of a Mac) are not photos."""
    found = folder.rglob("*") if recursive else folder.glob("*")
    for path in sorted(found, key=lambda path: path.relative_to(folder).as_posix()):
        hidden = any(part.startswith(".") for part in path.relative_to(folder).parts)
        if path.suffix.lower() in (*IMAGE_SUFFIXES, *HEIC_SUFFIXES) and not hidden and path.is_file():
            yield path


def read_photo_set(root: Path, images_dir: str | None = None) -> PhotoSet:
    """Look at the header of every photo; unreadable and repeated ones are left out and named in ``findings``.

    Raises:
        PrepareError: no photos, or none that can be read.
    """
    folder = find_photo_folder(root, images_dir)
    files = [] if folder is None else list(photo_files(folder, recursive=folder != root))
    if folder is None or not files:
        raise PrepareError(_no_photos(root if folder is None else folder))
    photos: list[Photo] = []
    unreadable: list[str] = []
    taken: set[str] = set()
    for path in files:
        try:
            photo = _inspect(path, folder, taken)
        except PrepareError as error:
            unreadable.append(str(error))
            continue
        taken.add(photo.name)
        photos.append(photo)
    photos, twins = _without_twins(photos)
    findings = [*_unreadable(unreadable, folder, len(files)), *_twins(twins, folder), *_sizes(photos, folder)]
    findings += [*_turned(photos, folder), *_raw_files(folder)]
    if not photos:
        raise PrepareError(f"none of the {len(files)} photos in {folder} can be read: {list_some(unreadable, 3)}")
    return PhotoSet(root, folder, tuple(photos), tuple(findings))


def _no_photos(folder: Path) -> str:
    nested = sorted({path.parent for path in photo_files(folder, recursive=True)})
    if nested:
        listed = list_some((path.relative_to(folder).as_posix() for path in nested), 5)
        return f"no photos in {folder} itself, but in {listed}: name the folder with scene.images_dir"
    raw = [path for path in folder.glob("*") if path.suffix.lower() in RAW_SUFFIXES]
    if raw:
        return f"{folder} holds {len(raw)} raw files ({raw[0].name} ...), which are not read: export them as JPEG"
    content = list_some(sorted(path.name for path in folder.iterdir()), 10) or "nothing"
    return f"no photos in {folder} ({', '.join(IMAGE_SUFFIXES)}), but {content}: correct scene.path"


def open_heic() -> bool:
    """Teach Pillow HEIC where pillow-heif is installed; says whether it is."""
    try:
        import pillow_heif
    except ImportError:
        return False
    pillow_heif.register_heif_opener()
    return True


def _inspect(path: Path, folder: Path, taken: set[str]) -> Photo:
    relative = path.relative_to(folder)
    heic = path.suffix.lower() in HEIC_SUFFIXES
    if heic and not open_heic():
        raise PrepareError(
            f"{relative}: HEIC needs the package pillow-heif: pip install -e '.[prepare]' in the clone of rtgs, or "
            "export JPEG"
        )
    if path.stat().st_size == 0:
        raise PrepareError(f"{relative}: an empty file (0 bytes)")
    try:
        with open_picture(path) as picture:
            size, exif = picture.size, read_exif(picture)
            refuse_pixels(size, path)
            picture.draft("RGB", (size[0] // 8, size[1] // 8))  # JPEG: an eighth is enough to see a broken file
            picture.load()
    except READ_ERRORS as error:
        raise PrepareError(f"{relative}: {str(error).replace(str(path), relative.name)}") from error
    if min(size) < 32:
        raise PrepareError(f"{relative}: {size[0]}x{size[1]} pixels are no photo")
    turn = exif.orientation
    camera = " ".join([*filter(None, [exif.camera]), f"{exif.focal:g} mm"]) if exif.focal else ""
    width, height = size[::-1] if turn in (5, 6, 7, 8) else size
    plain = path.suffix.lower() in _PLAIN
    name = relative.as_posix() if plain else relative.with_suffix(".jpg").as_posix()
    name = re.sub(r"\s", "_", name)  # COLMAP's lists of pairs separate names by blanks
    if name in taken:
        name = re.sub(r"\s", "_", f"{relative.as_posix()}.{len(taken)}{'' if plain else '.jpg'}")
        name = f"{name}{path.suffix}" if plain else name
    return Photo(path, name, width, height, turn != 1, camera)


def _without_twins(photos: list[Photo]) -> tuple[list[Photo], list[tuple[str, str]]]:
    """Drop copies of the same file; pairs (dropped, kept)."""
    kept: dict[str, Photo] = {}
    twins: list[tuple[str, str]] = []
    for photo in sorted(photos, key=lambda photo: (len(photo.name), photo.name)):
        state = photo.path.stat()
        key = content_hash(str(photo.path), state.st_size, state.st_mtime_ns)
        if key in kept:
            twins.append((photo.name, kept[key].name))
        else:
            kept[key] = photo
    return sorted(kept.values(), key=photos.index), sorted(twins)


def _unreadable(messages: list[str], folder: Path, count: int) -> list[Finding]:
    if not messages:
        return []
    what = f"{len(messages)} of {count} photos cannot be read and are left out"
    return [Finding("warning", what, str(folder), "copy or export them again", tuple(messages))]


def _twins(twins: list[tuple[str, str]], folder: Path) -> list[Finding]:
    if not twins:
        return []
    what = f"{len(twins)} photos are copies of others and are left out: "
    return [Finding("warning", what + list_some(f"{a} = {b}" for a, b in twins), str(folder))]


def _sizes(photos: list[Photo], folder: Path) -> list[Finding]:
    groups: dict[tuple[int, int, str], int] = {}
    for photo in photos:
        groups[photo.group] = groups.get(photo.group, 0) + 1
    if len(groups) < 2:
        return []
    listed = list_some(f"{n} of {w}x{h}{f' ({camera})' if camera else ''}" for (w, h, camera), n in groups.items())
    what = f"photos of {len(groups)} sizes or cameras, one lens is estimated for each: {listed}"
    few = len(groups) > max(2, len(photos) // 3)
    advice = "photos that were cropped one by one lose their lens: use the originals" if few else ""
    return [Finding("warning" if few else "info", what, str(folder), advice)]


def _turned(photos: list[Photo], folder: Path) -> list[Finding]:
    turned = [photo.name for photo in photos if photo.turned]
    if not turned:
        return []
    what = f"{len(turned)} of {len(photos)} photos are stored on their side and turned upright as EXIF says: "
    return [Finding("info", what + list_some(turned, 6), str(folder))]


def _raw_files(folder: Path) -> list[Finding]:
    raw = sorted(path.name for path in folder.rglob("*") if path.suffix.lower() in RAW_SUFFIXES)
    if not raw:
        return []
    what = f"{len(raw)} raw files are not read: {list_some(raw, 5)}"
    return [Finding("warning", what, str(folder), "export them as JPEG, unless their JPEG lies beside them")]


def lay_out(
    photos: PhotoSet, target: Path, background: tuple[float, float, float], advance: Callable[[int], None]
) -> None:
    """Fill ``target`` with upright pictures COLMAP can read, under their names; links where nothing changes."""
    for number, photo in enumerate(photos.photos, start=1):
        place = path_inside(target, photo.name)
        if not place.exists():
            place.parent.mkdir(parents=True, exist_ok=True)
            _lay_out_one(photo, place, background)
        advance(number)


def _lay_out_one(photo: Photo, place: Path, background: tuple[float, float, float]) -> None:
    path = photo.path
    if path.suffix.lower() in HEIC_SUFFIXES:
        open_heic()
    with open_picture(path) as picture:
        mode = picture.mode
        if path.suffix.lower() in _PLAIN and not photo.turned and mode in ("RGB", "L"):
            return _link(path, place)
        turn, tags = read_exif(picture).orientation, _upright_exif(picture, path)
        if mode in ("RGB", "L"):
            upright = turned_upright(picture, turn).convert("RGB")
        else:
            pixels = np.round(read_photo(path, background) * 255).astype(np.uint8)
            upright = turned_upright(Image.fromarray(pixels), turn)
    partial = place.with_name(f"{place.name}.part")
    kind = "PNG" if place.suffix.lower() == ".png" else "JPEG"
    upright.save(partial, kind, exif=tags, quality=_JPEG_QUALITY)
    partial.replace(place)
    return None


def _upright_exif(picture: Image.Image, path: Path) -> bytes:
    """What a photo's EXIF says, for the same photo turned upright."""
    try:
        exif = picture.getexif()
        exif[ORIENTATION] = 1
        return exif.tobytes()
    except EXIF_ERRORS as error:
        raise PrepareError(
            f"{path} has EXIF that cannot be carried over ({error}): remove it (exiftool -all=), or export the photo "
            "again"
        ) from error


def _link(source: Path, place: Path) -> None:
    try:
        place.symlink_to(source.resolve())
    except OSError:
        shutil.copyfile(source, place)


def write_ignored(photos: PhotoSet, folders: Sequence[Path], target: Path) -> int:
    """COLMAP's masks (``<name>.png``, black: no features) of the regions that masks in ``folders`` mark with non-zero.

    Every photo gets one as soon as any does: COLMAP takes no features at all from a photo without.

    Returns:
        How many photos have a masked region. One that covers the whole photo does not count: nothing would be left.

    Raises:
        CaptureError: an unreadable mask.
    """
    masks = {photo.name: [side_file(folder, photo, photos.folder) for folder in folders] for photo in photos.photos}
    if not any(path for paths in masks.values() for path in paths):
        return 0
    count = 0
    for photo in photos.photos:
        keep = np.ones((photo.height, photo.width), dtype=bool)
        for path in filter(None, masks[photo.name]):
            keep &= ~fitted_mask(path, photo)
        count += bool(keep.any() and not keep.all())
        place = path_inside(target, f"{photo.name}.png")
        place.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.where(keep | ~keep.any(), 255, 0).astype(np.uint8)).save(place)
    return count


def side_file(folder: Path, photo: Photo, images: Path, suffixes: tuple[str, ...] = MASK_SUFFIXES) -> Path | None:
    """The mask or normal map of a photo, by the name of its file or the name the model gives it."""
    original = photo.path.relative_to(images).as_posix()
    return existing_side_file(folder, original, suffixes) or existing_side_file(folder, photo.name, suffixes)


def fitted_mask(path: Path, photo: Photo) -> np.ndarray:
    """(H, W) bool at the size of the upright photo; masks painted on the stored photo are turned with it."""
    mask = read_mask(path)
    size = (mask.shape[1], mask.shape[0])
    if not same_aspect(size, (photo.width, photo.height)):
        if not (photo.turned and same_aspect(size[::-1], (photo.width, photo.height))):
            raise CaptureError(
                f"mask {path} is {size[0]}x{size[1]}, its photo {photo.name} {photo.width}x{photo.height}: the aspect "
                "ratios differ; make the mask from this very photo"
            )
        with open_picture(photo.path) as picture:
            turn = read_exif(picture).orientation
        mask = np.asarray(turned_upright(Image.fromarray(mask.astype(np.uint8)), turn)) != 0
    return nearest_resize(mask, photo.width, photo.height)
