"""Train a bias model and score it against the true poses."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from imutool import evaluation
from imutool.api import Init, checked, given_logs, init_text
from imutool.bias.model import BiasModel
from imutool.config import build
from imutool.file_location import LogPath, local, several
from imutool.mcap_io.storage import output_conflicts
from imutool.mcap_io.storage.output_conflicts import OutputFile, check_outputs

if TYPE_CHECKING:
    from imutool.recording import Recording
    from imutool.training.fit import Epoch


@checked
def train(
    logs: LogPath | Recording | Iterable[LogPath | Recording],
    out: str | Path,
    *,
    method: str = "hybrid",
    settings: Mapping[str, Any] | None = None,
    device: str = "cpu",
    imu: str | None = None,
    truth: str | None = None,
    resume: bool = False,
    overwrite: bool = False,
    progress: Callable[[Epoch], None] | None = None,
) -> BiasModel:
    """Train a bias model on logs of one sensor with true poses, and write it.

    Args:
        logs: MCAP logs, or recordings of arrays.
        out: Model file to write, `FILE.safetensors`.
        method: `hybrid`, `neural_ode`, `conv` or `linear`.
        settings: Training settings by name, for example `{"steps": 300, "seed": 1}`.
        device: `cpu` or `cuda`.
        imu: IMU topic; needed where the logs have several.
        truth: Topic of the true poses; by default the first.
        resume: Continue from the checkpoint of an interrupted training.
        overwrite: Replace an existing model.
        progress: Callback for each evaluation of the held-out part.

    Raises:
        ConfigError: The file exists, an unknown method or setting, or a checkpoint of another training.
        LogError: A log without IMU or truth.
        DataError: Different sample rates, or too little motion.
        NumericsError: The loss diverged.

    Examples:
        >>> import imutool
        >>> model = imutool.train(["flight_1.mcap"], "mine.safetensors", method="linear")
        >>> sorted(model.card["held_out"])
        ['accel', 'gyro']
    """
    from imutool.training.run import train as run
    from imutool.training.settings import placed, settings_of

    chosen = None if settings is None else build(settings_of(method), placed(method, settings), where="settings")
    with given_logs(logs, "logs") as given:
        files = [local(log, "logs") for log in given.places]
        check_outputs([OutputFile("out", out, output_conflicts.MODEL)], [files], overwrite=overwrite)
        return run(
            files,
            local(out, "out"),
            method=method,
            settings=chosen,
            device=device,
            imu=imu,
            truth=truth,
            resume=resume,
            overwrite=overwrite,
            progress=progress,
        )


@checked
def evaluate(
    log: LogPath | Recording,
    *,
    models: Sequence[str | Path | BiasModel] | str | Path | BiasModel = (),
    init: Init = "auto",
    smooth: bool = False,
    aid: str | None = None,
    truth: str | None = None,
    imu: str | None = None,
    trajectories: str | Path | None = None,
    overwrite: bool = False,
) -> list[dict[str, Any]]:
    """Score pure integration against the true poses, raw and with each model.

    Args:
        log: MCAP log with true poses, or a recording of arrays.
        models: Model files, names of models that ship, `static`, or loaded models; one, or several.
        init: Initial bias, as in `debias`.
        smooth: Smoothing, as in `debias`.
        aid: Also score the smoothed path with these aids: `auto` (all that the log has), or some of `stops`, `barometer`,
            `odometry` and `ground` with commas between; `barometer=TOPIC.field` and `odometry=TOPIC` name a topic.
        truth: Topic of the true poses; by default the first.
        imu: IMU topic; needed where the log has several.
        trajectories: Folder for trajectories in the TUM format.
        overwrite: Replace existing trajectories.

    Returns:
        One result for `raw` and one per model; without models, one for the samples that the log has debiased. Each has
        `aoe_deg`, `ape_m`, `roe_deg`, `rpe_m`, velocity error, and others. `fit` says whether the model fits the log.
        `drift_orientation_deg` is the error after five seconds from the truth, and `drift_orientation_std_deg` what the
        covariance of the bias expects; likewise for the velocity.

    Raises:
        ConfigError: Contradictory options, two models of one name, or files that exist.
        LogError: No IMU or no truth.
        DataError: IMU and truth share no time.
        ModelError: A model that cannot be read, or for another rate.

    Examples:
        >>> import imutool
        >>> raw, linear = imutool.evaluate("flight_2.mcap", models=["linear.safetensors"])
        >>> linear["aoe_deg"] < raw["aoe_deg"]
        True
    """
    tum = OutputFile("trajectories", trajectories, files=("*.tum",), keeps=True, of_each="{}_*.tum")
    chosen = several(models)
    with given_logs([log], "log") as given:
        (place,) = given.places
        check_outputs([tum], [place, chosen], overwrite=overwrite)
        return evaluation.evaluate(
            local(place, "log"),
            models=chosen,
            init=init_text(init),
            smooth=smooth,
            aid=aid,
            truth=truth,
            imu=imu,
            trajectories=None if trajectories is None else local(trajectories, "trajectories"),
            overwrite=overwrite,
        )
