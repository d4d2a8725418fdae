"""Turns raw inertial data into MCAP logs, learns how an IMU's bias evolves, and writes the debiased log."""

from pathlib import Path as _Path

__version__ = "0.1.0"

if not (_Path(__file__).parent / "converters").is_dir():  # a checkout: the wheel puts the folder inside the package
    __path__.append(str(_Path(__file__).parents[1]))
