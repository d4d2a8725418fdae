"""Fixed-lag smoother on preintegrated IMU samples and stereo tracks (GTSAM, extra `vio`).

States at each keyframe: pose, velocity and, where they are wanted, the biases of gyro and accelerometer. Between keyframes one
preintegrated factor (Forster et al., TRO 2017); at each, one stereo factor a track. Landmarks are states too and leave the lag
after their last sighting. Gravity is `recording.GRAVITY_M_S2` along -z. Samples are points of the signal, so a step sees
the mean of its two ends, as in `imutool.inertial.windows`.

The window is solved by Levenberg-Marquardt at every keyframe (`BatchFixedLagSmoother`). Its incremental sister takes
Gauss-Newton steps: as quick here, but after a few seconds without a camera it diverged on real IMUs, raw or debiased, unless
given six further steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, NamedTuple

import numpy as np
from msgspec import Meta
from scipy.spatial.transform import Rotation

from imutool import config
from imutool.array_types import Float64, Int64, Vectors
from imutool.errors import NumericsError, required
from imutool.inertial.strapdown import StartPose
from imutool.recording import GRAVITY_M_S2, Imu, Poses, seconds
from imutool.report import Progress, silent
from imutool.vio.camera import EUROC, Frame

Positive = Annotated[float, Meta(gt=0.0)]

INTEGRATION_STD = 1e-4  # m/sqrt(Hz), of the position within a step: what the rule of the mean leaves
FIXED_BIAS_STD = 1e-5  # rad/s and m/s²: a bias that is no state is zero this surely
LANDMARK_STD_M = 100.0  # weak, about its first place: a point that falls behind the camera leaves no hole in the system
MIN_DISPARITY_PX = 1.0  # a first place is no further away than this, whatever the noise


class SmootherSettings(config.Settings, frozen=True, kw_only=True):
    """Assumptions of the smoother about the sensor and the start.

    They are the same for every run, so that only the samples differ.

    The noise densities are ten times a data sheet's, for vibration, scale and misalignment, chosen on training sequences for
    the raw IMU with bias states. The accelerometer's walk is that of EuRoC's sensor.yaml, the gyro's five times that (figures
    stay, and GTSAM's Cholesky takes a walk much surer than the start's bias for an indeterminate system).
    """

    lag_s: Positive = 3.0  # of the past that a new keyframe still corrects
    gyro_noise_density: Positive = 2e-3  # rad/s/sqrt(Hz)
    accel_noise_density: Positive = 2e-2  # m/s²/sqrt(Hz)
    gyro_walk_density: Positive = 1e-4  # rad/s²/sqrt(Hz)
    accel_walk_density: Positive = 3e-3  # m/s³/sqrt(Hz)
    start_position_std_m: Positive = 1e-3  # of the start, which is the true pose
    start_attitude_std_rad: Positive = 5e-3  # of its attitude
    start_velocity_std_m_s: Positive = 0.05  # of its velocity
    start_gyro_bias_std: Positive = 0.1  # rad/s
    start_accel_bias_std: Positive = 0.3  # m/s²
    fastest_m_s: Positive = 50.0  # an estimate that claims more has diverged


class Estimate(NamedTuple):
    """Estimated state at each keyframe from the data up to it, and its bias.

    The bias is gyro (rad/s), then accel (m/s²).
    """

    poses: Poses
    bias: Float64[np.ndarray, "n 6"]


def load() -> Any:
    """GTSAM, if it is installed.

    Raises:
        ConfigError: it is not.
    """
    return required("gtsam", "vio", package="GTSAM", where="vio")


def estimate(
    imu: Imu,
    keyframes: Int64[np.ndarray, " k"],
    frames: Sequence[Frame],
    start: StartPose,
    settings: SmootherSettings,
    *,
    pixel_std: float,
    bias_states: bool,
    progress: Progress = silent,
) -> Estimate:
    """The trajectory at some samples of the IMU (`keyframes`, their rows).

    From the true start and the frames there.

    `pixel_std` (px) is what the pixels' noise is taken for. With `bias_states` false the samples are taken as they are: biases
    are zero and stay there.

    Raises:
        ConfigError: GTSAM is not installed.
        NumericsError: the estimate diverged; the message says when, and how.
    """
    run = _Run(load(), settings, pixel_std, bias_states=bias_states)
    t_s = seconds(imu.t_ns[keyframes], int(imu.t_ns[keyframes[0]]))
    rows = []
    for k, frame in enumerate(frames):
        try:
            if k == 0:
                run.begin(start)
            else:
                run.move(imu.rows(slice(int(keyframes[k - 1]), int(keyframes[k]) + 1)))
            run.see(frame)
            rows.append(run.solve(float(t_s[k])))
        except RuntimeError as error:  # all that GTSAM throws
            raise _diverged(float(t_s[k]), _reason(error)) from error
        _check(rows[-1], float(t_s[k]), settings.fastest_m_s)
        progress(k + 1, len(frames))
    table = np.array(rows)
    q_wb_wxyz = table[:, 3:7] / np.linalg.norm(table[:, 3:7], axis=1, keepdims=True)
    return Estimate(Poses(imu.t_ns[keyframes], table[:, :3], q_wb_wxyz, table[:, 7:10]), table[:, 10:])


def _check(row: Float64[np.ndarray, "16"], t_s: float, fastest_m_s: float) -> None:
    speed = float(np.linalg.norm(row[7:10]))
    if not np.isfinite(row).all():
        raise _diverged(t_s, "the state is not finite")
    if speed > fastest_m_s:
        raise _diverged(t_s, f"it claims {speed:.3g} m/s")


def _reason(error: RuntimeError) -> str:
    """The first sentence of what GTSAM says; an explanation follows it that is meant for its programmers."""
    return str(error).strip().split(". ", 1)[0].split("\n\n", 1)[0].replace("\n", " ")


def _diverged(t_s: float, reason: str) -> NumericsError:
    return NumericsError(
        f"the smoother diverged after {t_s:.2f} s ({reason})",
        expected="a consistent estimate",
        fix="Give it bias states, a debiased IMU or larger noise densities",
    )


class _Run:
    """The smoother and what is to be added to it at the next keyframe."""

    def __init__(self, gtsam: Any, settings: SmootherSettings, pixel_std: float, *, bias_states: bool) -> None:
        self._gtsam, self._settings, self._bias_states = gtsam, settings, bias_states
        self._smoother = gtsam.BatchFixedLagSmoother(settings.lag_s)
        self._params = _preintegration(gtsam, settings, bias_states=bias_states)
        self._pixel_noise = gtsam.noiseModel.Isotropic.Sigma(3, pixel_std)
        self._landmark_noise = gtsam.noiseModel.Isotropic.Sigma(3, LANDMARK_STD_M)
        self._fixed_bias = gtsam.noiseModel.Isotropic.Sigma(6, FIXED_BIAS_STD)
        self._calibration = gtsam.Cal3_S2Stereo(EUROC.fx, EUROC.fy, 0.0, EUROC.cx, EUROC.cy, EUROC.baseline_m)
        self._body_from_camera = gtsam.Pose3(gtsam.Rot3(EUROC.R_bc), EUROC.p_bc)
        self._k, self._known = 0, set[int]()
        self._state = gtsam.NavState()
        self._bias = gtsam.imuBias.ConstantBias()
        self._fresh()

    def _fresh(self) -> None:
        self._graph, self._values = self._gtsam.NonlinearFactorGraph(), self._gtsam.Values()
        self._touched: list[int] = []

    def _keys(self, k: int) -> tuple[int, int, int]:
        """Pose, velocity and bias of a keyframe."""
        pose, velocity, bias = (self._gtsam.symbol(letter, k) for letter in "xvb")
        return pose, velocity, bias

    def _insert(self) -> None:
        """The predicted state as the first guess of a keyframe."""
        pose, velocity, bias = self._keys(self._k)
        self._values.insert(pose, self._state.pose())
        self._values.insert(velocity, self._state.velocity())
        self._values.insert(bias, self._bias)
        self._touched += [pose, velocity, bias]

    def begin(self, start: StartPose) -> None:
        """The true start, as surely as the settings say; position and heading fix what nothing measures."""
        gtsam, settings = self._gtsam, self._settings
        pose = gtsam.Pose3(gtsam.Rot3.Quaternion(*start.q_wb_wxyz), start.p_wb)
        self._state = gtsam.NavState(pose, start.v_w)
        diagonal = gtsam.noiseModel.Diagonal.Sigmas
        pose_std = np.repeat([settings.start_attitude_std_rad, settings.start_position_std_m], 3)
        bias_std = np.repeat([settings.start_accel_bias_std, settings.start_gyro_bias_std], 3)  # GTSAM: accel first
        pose_key, velocity_key, bias_key = self._keys(0)
        self._graph.add(gtsam.PriorFactorPose3(pose_key, pose, diagonal(pose_std)))
        velocity_noise = gtsam.noiseModel.Isotropic.Sigma(3, settings.start_velocity_std_m_s)
        self._graph.add(gtsam.PriorFactorVector(velocity_key, start.v_w, velocity_noise))
        bias_noise = diagonal(bias_std) if self._bias_states else self._fixed_bias
        self._graph.add(gtsam.PriorFactorConstantBias(bias_key, self._bias, bias_noise))
        self._insert()

    def move(self, imu: Imu) -> None:
        """One factor from the last keyframe to the next; `imu` is from the one's sample to the other's."""
        gtsam = self._gtsam
        kind = gtsam.PreintegratedCombinedMeasurements if self._bias_states else gtsam.PreintegratedImuMeasurements
        preintegrated = kind(self._params, self._bias)
        for force, rate, dt in zip(*_steps(imu, self._bias.gyroscope()), strict=True):
            preintegrated.integrateMeasurement(force, rate, dt)
        before, (pose, velocity, bias) = self._keys(self._k), self._keys(self._k + 1)
        if self._bias_states:
            self._graph.add(gtsam.CombinedImuFactor(before[0], before[1], pose, velocity, before[2], bias, preintegrated))
        else:
            self._graph.add(gtsam.ImuFactor(before[0], before[1], pose, velocity, before[2], preintegrated))
            self._graph.add(gtsam.PriorFactorConstantBias(bias, self._bias, self._fixed_bias))
        self._state = preintegrated.predict(self._state, self._bias)
        self._k += 1
        self._insert()

    def see(self, frame: Frame) -> None:
        """One factor a track; a new track is put where its first pixels say, seen from the predicted pose."""
        gtsam, pose = self._gtsam, self._keys(self._k)[0]
        camera = self._state.pose().compose(self._body_from_camera)
        nearest = frame.pixels.copy()
        nearest[:, 1] = np.minimum(nearest[:, 1], nearest[:, 0] - MIN_DISPARITY_PX)
        places_c = EUROC.back_project(nearest)
        for track, pixels, place_c in zip(frame.tracks.tolist(), frame.pixels, places_c, strict=True):
            key = gtsam.symbol("l", track)
            if track not in self._known:
                self._known.add(track)
                place_w = camera.transformFrom(place_c)
                self._values.insert(key, place_w)
                self._graph.add(gtsam.PriorFactorPoint3(key, place_w, self._landmark_noise))
            measured = gtsam.StereoPoint2(*pixels)
            self._graph.add(
                gtsam.GenericStereoFactor3D(measured, self._pixel_noise, pose, key, self._calibration, self._body_from_camera)
            )
            self._touched.append(key)

    def solve(self, t_s: float) -> Float64[np.ndarray, "16"]:
        """Adds what has come, and returns the newest state: position, quaternion wxyz, velocity, gyro and accel bias."""
        smoother = self._smoother
        smoother.update(self._graph, self._values, dict.fromkeys(self._touched, t_s))
        self._fresh()
        pose_key, velocity_key, bias_key = self._keys(self._k)
        pose = smoother.calculateEstimatePose3(pose_key)
        velocity = smoother.calculateEstimateVector(velocity_key)
        if self._bias_states:
            self._bias = smoother.calculateEstimateConstantBias(bias_key)
        self._state = self._gtsam.NavState(pose, velocity)
        q = pose.rotation().toQuaternion()
        bias = (self._bias.gyroscope(), self._bias.accelerometer())
        return np.concatenate([pose.translation(), [q.w(), q.x(), q.y(), q.z()], velocity, *bias])


def _steps(imu: Imu, b_g: Float64[np.ndarray, "3"]) -> tuple[Vectors, Vectors, list[float]]:
    """Specific force and angular rate over each step, and its length in s, as GTSAM holds them.

    The rate w is the mean of both ends, the force (a_k + Exp((w - b_g) dt) a_{k+1}) / 2: with its second half turned to the
    first frame, GTSAM's rule becomes the trapezoidal one. Else it is off by w dt x a / 2, at 1 rad/s and 200 Hz by 0.025 m/s².
    """
    dt = np.diff(imu.t_ns) * 1e-9
    rate = 0.5 * (imu.gyro[:-1] + imu.gyro[1:])
    turned = Rotation.from_rotvec((rate - b_g) * dt[:, None]).as_matrix()
    force = 0.5 * (imu.accel[:-1] + np.einsum("kij,kj->ki", turned, imu.accel[1:]))
    return force, rate, dt.tolist()


def _preintegration(gtsam: Any, settings: SmootherSettings, *, bias_states: bool) -> Any:
    """Noise of the samples, gravity downwards."""
    kind = gtsam.PreintegrationCombinedParams if bias_states else gtsam.PreintegrationParams
    params = kind.MakeSharedU(GRAVITY_M_S2)
    params.setGyroscopeCovariance(np.eye(3) * settings.gyro_noise_density**2)
    params.setAccelerometerCovariance(np.eye(3) * settings.accel_noise_density**2)
    params.setIntegrationCovariance(np.eye(3) * INTEGRATION_STD**2)
    if bias_states:
        params.setBiasOmegaCovariance(np.eye(3) * settings.gyro_walk_density**2)
        params.setBiasAccCovariance(np.eye(3) * settings.accel_walk_density**2)
    return params
