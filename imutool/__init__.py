"""Convert raw IMU data to MCAP logs, learn the IMU's bias, and write debiased logs.

From a raw folder to a debiased log::

    import imutool

    logs = imutool.convert("raw", "logs").written                             # one MCAP log per sequence
    imutool.train(logs[:-1], "sensor.safetensors", method="linear")           # or the default, "hybrid"
    imutool.debias(logs[-1], "debiased.mcap", model="sensor.safetensors")     # adds /imu0/debiased
    for result in imutool.evaluate(logs[-1], models=["sensor.safetensors"]):  # against the true poses
        print(result["model"], result["aoe_deg"])
    recording = imutool.read(logs[-1])                                        # numpy arrays: recording.imu.gyro
    debiased = imutool.debias(recording, imutool.load_model("sensor.safetensors"))
    print(debiased.imu.gyro - recording.imu.gyro)                             # arrays in, arrays out
    imutool.view("debiased.mcap", html="debiased.html")                       # one page; without html a viewer opens

Units: gyro in rad/s, accel (specific force) in m/s², time in integer nanoseconds, quaternions as w, x, y, z.
Every error is an `ImutoolError`. Its message names the place, the problem, what was expected, and what to do.
"""

from importlib import import_module as _import_module
from pathlib import Path as _Path
from typing import TYPE_CHECKING

__version__ = "0.1.0"

if TYPE_CHECKING:
    from imutool.api.cleaning import CleanReport, clean, repair
    from imutool.api.logs import convert, export, info, read, write
    from imutool.api.models import DebiasedRecording, bias_at_rest, debias, load_model
    from imutool.api.sensors import diagnose, example_recording, simulate
    from imutool.api.training import evaluate, train
    from imutool.api.views import LiveView, load_run, notebook_page, notebook_viewer, view, watch
    from imutool.bias.model import BiasModel
    from imutool.bias_start.correction import OnlineDebiaser
    from imutool.bias_start.initial_bias import InitialBias
    from imutool.errors import ConfigError, DataError, ImutoolError, LogError, ModelError, NumericsError
    from imutool.mcap_io.log import Log
    from imutool.recording import Frames, Imu, Poses, Recording, Scalars

_HOMES = {  # public names by the module that defines them; a name is imported when it is first used
    "imutool.api.cleaning": ("CleanReport", "clean", "repair"),
    "imutool.api.logs": ("convert", "export", "info", "read", "write"),
    "imutool.api.models": ("DebiasedRecording", "bias_at_rest", "debias", "load_model"),
    "imutool.api.sensors": ("diagnose", "example_recording", "simulate"),
    "imutool.api.training": ("evaluate", "train"),
    "imutool.api.views": ("LiveView", "load_run", "notebook_page", "notebook_viewer", "view", "watch"),
    "imutool.bias.model": ("BiasModel",),
    "imutool.bias_start.initial_bias": ("InitialBias",),
    "imutool.bias_start.correction": ("OnlineDebiaser",),
    "imutool.errors": ("ConfigError", "DataError", "ImutoolError", "LogError", "ModelError", "NumericsError"),
    "imutool.mcap_io.log": ("Log",),
    "imutool.recording": ("Frames", "Imu", "Poses", "Recording", "Scalars"),
}
_HOME = {name: module for module, names in _HOMES.items() for name in names}

__all__ = [
    "BiasModel",
    "CleanReport",
    "ConfigError",
    "DataError",
    "DebiasedRecording",
    "Frames",
    "Imu",
    "ImutoolError",
    "InitialBias",
    "LiveView",
    "Log",
    "LogError",
    "ModelError",
    "NumericsError",
    "OnlineDebiaser",
    "Poses",
    "Recording",
    "Scalars",
    "__version__",
    "bias_at_rest",
    "clean",
    "convert",
    "debias",
    "diagnose",
    "evaluate",
    "example_recording",
    "export",
    "info",
    "load_model",
    "load_run",
    "notebook_page",
    "notebook_viewer",
    "read",
    "repair",
    "simulate",
    "train",
    "view",
    "watch",
    "write",
]


if not TYPE_CHECKING:  # a type checker names a misspelt attribute

    def __getattr__(name: str) -> object:
        """Import a public name when it is first used (PEP 562)."""
        if name not in _HOME:
            raise AttributeError(f"module 'imutool' has no attribute {name!r}")
        value = getattr(_import_module(_HOME[name]), name)
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    """Public names, also before they are imported; no modules, which are private."""
    return sorted({*__all__, *(name for name in globals() if name.startswith("__"))})


if not (_Path(__file__).parent / "converters").is_dir():  # a checkout: the wheel puts the folder inside the package
    __path__.append(str(_Path(__file__).parents[1]))
