"""The real recordings read: every sequence, with its counts and stamps."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imutool.converters import euroc, fetch, tum_vi

# name: IMU rows, true poses, first IMU stamp (ns) as printed in the file, whether the truth has velocity and biases
EXPECTED = {
    "euroc": {
        "MH_01_easy": (36820, 36382, 1403636579758560000, True, False),
        "MH_03_medium": (27008, 26302, 1403637130498319104, True, False),
        "MH_04_difficult": (20320, 19753, 1403638127270096896, True, True),
        "MH_05_difficult": (22721, 22212, 1403638518097829376, True, True),
        "V1_01_easy": (29120, 28712, 1403715273262142976, True, False),
        "V1_02_medium": (17100, 16702, 1403715523912143104, True, True),
        "V1_03_difficult": (21500, 20932, 1403715886544058112, True, True),
        "V2_01_easy": (22800, 22401, 1413393212225760512, True, True),
        "V2_02_medium": (23490, 23091, 1413393885975760384, True, True),
        "V2_03_difficult": (23370, 22970, 1413394881575760384, True, True),
    },
    "tumvi": {
        "room1": (28122, 16541, 1520530308181901469, False, False),
        "room2": (28732, 15477, 1520530731372454010, False, False),
        "room3": (28124, 15200, 1520530962735370731, False, False),
        "room4": (22212, 13075, 1520531124153717567, False, False),
        "room5": (28381, 16999, 1520531467566265223, False, False),
        "room6": (26281, 15244, 1520621014560423941, False, False),
    },
    "fetch": {
        "01_square": (4373, 4077, 1691116804753040896, False, False),
        "03_um": (4994, 4570, 1691117384993539072, False, False),
        "04_eight": (3399, 3082, 1691117483944093440, False, False),
        "05_random": (9912, 8850, 1691117558834970368, False, False),
        "06_right_turn": (4088, 3674, 1691117773285322752, False, False),
        "07_left_turn": (5249, 4825, 1691119075075499008, False, False),
        "08_origin": (4585, 4169, 1691119217562564352, False, False),
    },
}
PLACES = {"euroc": euroc, "tumvi": tum_vi, "fetch": fetch}


@pytest.mark.parametrize("place", PLACES)
def test_every_sequence_reads_with_its_counts_and_exact_stamps(data, place):
    module = PLACES[place]
    found = {recording.name: recording for recording in module.read(data / place)}
    assert set(found) == set(EXPECTED[place])
    for name, recording in found.items():
        rows, poses, first_ns, moving, biases = EXPECTED[place][name]
        assert (len(recording.imu), len(recording.truth), int(recording.imu.t_ns[0])) == (rows, poses, first_ns), name
        assert (recording.truth.v_w is not None) == moving, name
        assert ("/ground_truth/bias/gyro" in recording.scalars) == biases, name
        assert "imutool/repairs" not in recording.metadata, name  # none of these recordings needs one


def test_each_sequence_is_recognised_by_exactly_one_converter(data):
    claims = {
        sequence.path: [module.DATASET for module in PLACES.values() if module.recognises(sequence)]
        for place in PLACES
        for sequence in euroc.sequences(data / place)
    }
    assert len(claims) == sum(map(len, EXPECTED.values()))
    converter = {"euroc": "euroc", "tumvi": "tum_vi"}
    assert all(claim == [converter.get(path.parent.name, "fetch")] for path, claim in claims.items())


def test_the_recomputed_truth_of_v1_01_is_a_second_one(data):
    (recording,) = euroc.read(data / "euroc" / "V1_01_easy.zip")
    second = recording.truths["/ground_truth_recomputed/pose"]
    assert len(second) == 2895
    assert second.period_s == pytest.approx(0.05, abs=1e-6)
    poses, valid = second.at(recording.truth.t_ns)
    apart = np.linalg.norm(poses.p_wb - recording.truth.p_wb, axis=1)[valid]
    assert np.median(apart) < 0.1  # two estimates of one flight differ by centimetres; swapped columns by metres


def test_specific_force_at_rest_is_gravity_upwards_in_the_world(data):
    """Quaternion order and direction: R_wb times what the IMU feels, on the ground, is +g along world z."""
    for source, module in ((data / "euroc" / "MH_04_difficult.zip", euroc), (data / "fetch" / "05_random", fetch)):
        (recording,) = module.read(source)
        cut = recording.overlap()
        poses, _ = cut.truth.at(cut.imu.t_ns)
        start = slice(0, 100)
        turn = Rotation.from_quat(poses.q_wb_wxyz[start], scalar_first=True)
        mean = turn.apply(cut.imu.accel[start].copy()).mean(axis=0)
        assert mean[2] == pytest.approx(9.81, abs=0.35)  # FETCH's accelerometer reads 2.4 % low
        assert np.hypot(mean[0], mean[1]) < 0.6  # its bias is up to 0.3 m/s² on an axis
