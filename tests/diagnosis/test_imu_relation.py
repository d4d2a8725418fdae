"""Two IMUs of one body in a log of another tool's topics: how they sit, and how their clocks differ."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer
from scipy.spatial.transform import Rotation
from support import planted

from imutool import diagnosis_output
from imutool.diagnosis.compared_logs import ComparedLogs
from imutool.diagnosis.settings import DiagnoseSettings, SearchSettings
from imutool.mcap_io.codec import schemas
from imutool.mcap_io.codec.encode import encode_imu, encode_pose

FIRST, OTHER, POSES = "/camera/imu/data_raw", "/rear_unit/imu", "/mocap/base/pose"
TURNED = Rotation.from_euler("zyx", [92.0, -8.0, 5.0], degrees=True)  # takes vectors of the other to the first
ARM, CLOCK_S, OTHER_S = np.array([-0.3, 0.12, 0.05]), 0.006, 1.0 / 160.0
SURE = 4.0
BRIEFLY = DiagnoseSettings(search=SearchSettings(rounds=1))  # the comparison of IMUs is next to the search


@pytest.fixture(scope="module", params=[True, False], ids=["poses", "no poses"])
def log(tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest) -> Path:
    """Two IMUs at rates of their own, with or without poses of the first."""
    felt, path = planted.rich(), planted.moving()
    other_s = np.arange(round((planted.DURATION_S - 1.0) / OTHER_S)) * OTHER_S
    moved = planted.ideal(felt, planted.acting({"lever_arm": ARM, "clock_offset": [CLOCK_S]}), other_s)
    other = np.concatenate([TURNED.inv().apply(moved[:, :3]), TURNED.inv().apply(moved[:, 3:])], axis=1)
    poses = planted.poses(path, felt.t_s)
    out = tmp_path_factory.mktemp("two") / "robot.mcap"
    with out.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2", "another tool")
        rows = []
        for topic, t_s, samples, seed in ((FIRST, felt.t_s, planted.ideal(felt), 1), (OTHER, other_s, other, 2)):
            read = samples + planted.noise(len(t_s), seed) + seed * planted.BIAS
            t_ns = planted.START_NS + np.round(t_s * 1e9).astype(np.int64)
            rows.append((schemas.IMU, topic, t_ns, encode_imu(t_ns, read[:, :3], read[:, 3:], "unit")))
        if request.param:
            rows.append((schemas.POSE, POSES, poses.t_ns, encode_pose(poses.t_ns, poses.p_wb, poses.q_wb_wxyz, "world")))
        for schema, topic, t_ns, payloads in rows:
            kind = writer.register_schema(schema, "ros2msg", schemas.definition(schema).encode())
            channel = writer.register_channel(topic, "cdr", kind)
            for k, (stamp, payload) in enumerate(zip(t_ns.tolist(), payloads, strict=True)):
                writer.add_message(channel, stamp, payload.tobytes(), stamp, k)
        writer.finish()
    return out


@pytest.mark.parametrize("first", [None, OTHER])
def test_the_imus_of_a_log_are_compared_with_each_other(log: Path, first: str | None, tmp_path: Path) -> None:
    """Its page shows the IMU whose findings they are: it was left out where none was asked for."""
    d, left_out = diagnosis_output.diagnose(ComparedLogs([log], imu=first, settings=BRIEFLY), tmp_path / "out")
    assert left_out == []
    pages = [page.read_text(encoding="utf-8") for page in (tmp_path / "out").glob(diagnosis_output.LOG)]
    assert [(first or FIRST) in page for page in pages] == [True] * bool(np.isfinite(d.bias).all())  # next to a reference
    topic, R, arm, clock = (
        (OTHER, TURNED, ARM, CLOCK_S) if first is None else (FIRST, TURNED.inv(), -TURNED.inv().apply(ARM), -CLOCK_S)
    )
    (relation,) = d.report.imus.values()
    assert list(d.imus) == [topic]
    truth = dict(zip([f"rotation_{a}" for a in "xyz"], R.as_rotvec(), strict=True)) | {"clock": clock}
    truth |= dict(zip([f"arm_{a}" for a in "xyz"], arm, strict=True))
    off = {name: (relation[name].value - value) / relation[name].std for name, value in truth.items()}
    assert max(map(abs, off.values())) < SURE, off
    assert all(relation[f"arm_{a}"].std < 0.01 for a in "xyz")
    assert any(f"{topic} sits at" in remark for remark in d.remarks)
