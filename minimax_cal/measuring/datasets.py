"""Public measurements: fetched once, checked, kept; or read from a folder without a network."""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass, replace
from pathlib import Path

from minimax_cal.core.errors import CalibrationError, DataError, OptionError
from minimax_cal.core.optional_packages import import_optional
from minimax_cal.measuring.importers import import_files
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.robots.robot import Robot, load_robot

DATA_FOLDER_VARIABLE = "MINIMAX_CAL_DATA"  # environment variable of the override folder
UNKNOWN_HASH = ""  # a hash nobody has taken yet


@dataclass(frozen=True)
class Source:
    """A file of a public set: where it is, its SHA-256 (or UNKNOWN), its licence and its source."""

    name: str
    url: str
    sha256: str
    licence: str
    cite: str


IPA_DATA_URL = (
    "https://raw.githubusercontent.com/christianlandgraf/ipa-robot-accuracy/"
    "507fba69bdaf6c43c2faf306e70a7e37c5e39b89"
)
IPA_CITATION = (
    "Landgraf, Ernst, Schleth, Fabritius, Huber: A Hybrid Neural Network Approach for Increasing "
    "the Absolute Accuracy of Industrial Robots, IEEE CASE 2021"
)
# The hashes are not known: this registry was written without a network.
UR10 = {
    series: Source(
        f"Series_{series}/{name}",
        f"{IPA_DATA_URL}/Series_{series}/{name}",
        UNKNOWN_HASH,
        "MIT",
        IPA_CITATION,
    )
    for series, name in {
        "A": "measurements_grid.csv",
        "B": "measurements_joint_configurations.csv",
        "C": "measurements_random_poses.csv",
        "D": "measurements_iso_cubes.csv",
    }.items()
}


def fetch_ur10(
    series: str = "B", folder: Path | str | None = None, *, unverified: bool = False
) -> tuple[Robot, Measurements]:
    """A UR10 with a 6D tracker on its flange: the robot as drawn, and one of the series A to D.

    folder: where the file is already (else the folder in MINIMAX_CAL_DATA, else the cache).
    unverified: download even though the file's hash is not known.  The target is the origin of the
    tracker's 6D sensor.  MIT licence; cite [Landgraf 2021].  Raises CalibrationError.
    """
    if series not in UR10:
        raise OptionError(f"series {series!r}: choose one of {', '.join(UR10)}")
    source = UR10[series]
    path = fetch(source, folder, unverified=unverified)
    data = import_files([path], units={"q": "rad", "smr": "mm", "temperature": "C"}).data
    notices = (f"{source.licence} licence; cite {source.cite}", *data.notices)
    if not source.sha256:
        notices = (f"{path}: not verified, its SHA-256 is {compute_sha256(path)}", *notices)
    return load_robot("ur10"), replace(data, notices=notices)


def fetch(source: Source, folder: Path | str | None = None, *, unverified: bool = False) -> Path:
    """The file of a source: from the folder, else from the cache, else downloaded into it.

    A folder (given, or named by MINIMAX_CAL_DATA) is the only place that is then looked at.
    Raises DataError where the file is missing or is not the one that was published.
    """
    folder = folder if folder is not None else os.environ.get(DATA_FOLDER_VARIABLE) or None
    if folder is not None:
        places = [Path(folder) / source.name, Path(folder) / Path(source.name).name]
        found = next((path for path in places if path.is_file()), None)
        if found is None:
            raise DataError(
                f"{places[0]}: is not there; download {source.url} to it, or leave the folder "
                f"(and {DATA_FOLDER_VARIABLE}) out"
            )
        return check_published_hash(found, source)
    if not (source.sha256 or unverified):
        raise DataError(
            f"{source.name}: its SHA-256 is not known to this version, so it is not downloaded; "
            f"download {source.url} and give its folder (or set "
            f"{DATA_FOLDER_VARIABLE}), or pass unverified=True"
        )
    return check_published_hash(download_to_cache(source), source)


def download_to_cache(source: Source) -> Path:
    """The file in the cache, downloaded where it is not there.  Raises CalibrationError."""
    pooch = import_optional("pooch", "downloading", "minimax-cal[datasets]")
    name = Path(source.name)
    try:
        path = pooch.retrieve(
            source.url,
            known_hash=f"sha256:{source.sha256}" if source.sha256 else None,
            fname=name.name,
            path=Path(pooch.os_cache("minimax-cal")) / name.parent,
            progressbar=False,
        )
    except ValueError as error:  # the hash differs: pooch keeps nothing
        raise DataError(f"{source.url}: is not the file that was published ({error})") from error
    except OSError as error:
        raise CalibrationError(
            f"{source.url}: cannot be downloaded ({error}); get it by other means and give its "
            f"folder (or set {DATA_FOLDER_VARIABLE})"
        ) from error
    return Path(path)


def compute_sha256(path: Path) -> str:
    """SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def check_published_hash(path: Path, source: Source) -> Path:
    """The path, if its hash is the known one or none is known.  Raises DataError."""
    if source.sha256 and compute_sha256(path) != source.sha256:
        raise DataError(
            f"{path}: is not the file that was published (SHA-256 {compute_sha256(path)}, expected "
            f"{source.sha256}); download {source.url} again"
        )
    return path
