"""Read depth images (NPZ, TIFF) and a TOML table of their cameras (`docs/reference/scan-files.md`)."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from surffollow.config.input_file import check_plain_file, contents_are_read
from surffollow.config.toml_file import read_toml
from surffollow.errors import ScanFileError
from surffollow.extras import install_command
from surffollow.map.formats.npz import DAMAGED_ARCHIVE
from surffollow.scan.camera import Camera
from surffollow.scan.checks import Floats

IMAGE_SUFFIXES = (".npz", ".tif", ".tiff")
KEYS = {"depth_m": "depth", "disparity_px": "disparity"}
CAMERA_KEYS = (
    "fx_px",
    "fy_px",
    "cx_px",
    "cy_px",
    "ground_from_camera",
    "baseline_m",
    "disparity_offset_px",
    "min_range_m",
    "max_range_m",
)


@dataclass(frozen=True)
class DepthImage:
    """One image and its camera; `kind` says whether its values are depths or disparities."""

    values: Floats
    kind: str
    camera: Camera


@contents_are_read()
def read_images(
    files: list[str | os.PathLike[str]], cameras: str | os.PathLike[str] | None
) -> list[DepthImage]:
    """Images with the cameras that a TOML file gives them by file name.

    Parameters
    ----------
    files : list of paths
        .npz or .tif
    cameras : path or None
        TOML file of cameras; None: the images have them

    Returns
    -------
    list of DepthImage
        in the order of the files

    Raises
    ------
    ScanFileError
        a file that cannot be read, or an image without camera

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import numpy as np
    >>> from surffollow.scan import read_images
    >>> camera = 'images."a.npz" = { fx_px = 60.0, fy_px = 60.0, cx_px = 31.5, cy_px = 23.5 }'
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     np.savez(Path(folder, "a.npz"), depth_m=np.ones((48, 64)))
    ...     size = Path(folder, "cameras.toml").write_text(camera)
    ...     (image,) = read_images([Path(folder, "a.npz")], Path(folder, "cameras.toml"))
    >>> image.kind, image.values.shape, image.camera.fx_px
    ('depth', (48, 64), 60.0)
    """
    table = _cameras(cameras) if cameras is not None else {}
    return [_read(Path(f), table, cameras) for f in files]


def _read(path: Path, table: dict[str, Any], cameras: Any) -> DepthImage:
    check_plain_file(path, ScanFileError)
    own_kind = path.suffix.lower() == ".npz"
    values, kind = _npz(path) if own_kind else _tiff(path)
    images = table.get("images", {})
    own = images.get(path.name)
    if own is None:
        where = f'[images."{path.name}"] in {cameras}' if cameras else "a TOML file (--cameras)"
        raise ScanFileError(f"{path} has no camera; give it in {where}")
    given = table.get("default", {}) | own
    if not own_kind:
        kind = str(given.get("kind", kind))
    elif own.get("kind", kind) != kind:
        raise ScanFileError(f"{path} holds a {kind} image; {cameras} says that it is of kind {own['kind']!r}")
    unknown = sorted(set(given) - set(CAMERA_KEYS) - {"kind"})
    if unknown:
        raise ScanFileError(
            f"{cameras}: unknown keys {', '.join(unknown)}; there are {', '.join(CAMERA_KEYS)}"
        )
    missing = [k for k in CAMERA_KEYS[:4] if k not in given]
    if missing:
        raise ScanFileError(f"{cameras}: the camera of {path.name} lacks {', '.join(missing)}")
    if kind not in ("depth", "disparity"):
        raise ScanFileError(f"{cameras}: kind of {path.name} is '{kind}'; expected depth or disparity")
    return DepthImage(
        values, kind, Camera(**{k: given[k] for k in CAMERA_KEYS if k in given}, name=path.name)
    )


def _npz(path: Path) -> tuple[Floats, str]:
    try:
        with np.load(path, allow_pickle=False) as data:
            for key, kind in KEYS.items():
                if key in data:
                    return _real(data[key], path, key), kind
            names = list(data)
    except DAMAGED_ARCHIVE as e:
        reason = getattr(e, "strerror", None)  # NumPy's texts advise to load foreign bytes unsafely
        raise ScanFileError(
            f"cannot read {path}: {reason or 'it is damaged, or no NPZ file of numbers; write it again'}"
        ) from None
    raise ScanFileError(f"{path} holds {', '.join(names) or 'nothing'}; expected depth_m or disparity_px")


def _real(values: Any, path: Path, key: str) -> Floats:
    """The values as float64; complex numbers, texts and records are none."""
    if values.dtype.kind not in "biuf":
        raise ScanFileError(f"{key} of {path} has the type {values.dtype}; expected real numbers")
    return np.asarray(values, np.float64)


def _tiff(path: Path) -> tuple[Floats, str]:
    if path.suffix.lower() not in IMAGE_SUFFIXES:
        raise ScanFileError(f"{path} is no depth image; expected one of {', '.join(IMAGE_SUFFIXES)}")
    try:
        import rasterio
        from rasterio.errors import NotGeoreferencedWarning, RasterioIOError
    except ImportError as e:
        raise ScanFileError(f"TIFF images need rasterio: {install_command('geo')}") from e
    import warnings

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            # files of other drivers may name further files and network addresses to read
            with rasterio.open(path, driver="GTiff") as source:
                band = source.read(1, masked=True)
            if band.dtype.kind not in "biuf":
                raise ScanFileError(f"{path} has the type {band.dtype}; expected real numbers")
            return np.asarray(band.astype(np.float64).filled(np.nan)), "depth"
    except RasterioIOError as e:
        raise ScanFileError(f"cannot read {path}: {e}") from e


def _cameras(path: str | os.PathLike[str]) -> dict[str, Any]:
    check_plain_file(path, ScanFileError)
    return read_toml(Path(path), "cameras", ScanFileError, ScanFileError)
