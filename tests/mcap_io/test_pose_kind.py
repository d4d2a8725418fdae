"""What poses are worth: stated by the channel, else read from the topic's name, else from the message type."""

from __future__ import annotations

import pytest

from imutool.mcap_io.codec import schemas
from imutool.mcap_io.topics import KIND_KEY, Topic


@pytest.mark.parametrize(
    ("name", "schema", "kind"),
    [
        ("/ground_truth/pose", schemas.POSE, "truth"),
        ("/ground_truth_recomputed/pose", schemas.POSE, "truth"),
        ("/vrpn_client_node/drone/pose", schemas.POSE, "truth"),
        ("/gazebo/ground_truth/state", schemas.ODOMETRY, "truth"),
        ("/husky_velocity_controller/odom", schemas.ODOMETRY, "odometry"),
        ("/robot/state", schemas.ODOMETRY, "odometry"),
        ("/odometry/filtered", schemas.ODOMETRY, "estimate"),
        ("/vins_estimator/odometry", schemas.ODOMETRY, "estimate"),
        ("/mavros/local_position/pose", schemas.POSE, "estimate"),
        ("/localization/pose_estimator/pose", schemas.POSE, "estimate"),
        ("/zed/zed_node/pose", schemas.POSE, "estimate"),
        ("/goal_pose", schemas.POSE, "command"),
        ("/mavros/setpoint_position/local", schemas.POSE, "command"),
        ("/vicon/goal/pose", schemas.POSE, "truth"),
        ("/wheel/pose", schemas.POSE, "odometry"),
        ("/pose", schemas.POSE, "unknown"),
        ("/robot/pose", schemas.POSE_COVARIANCE, "estimate"),
        ("/vicon/pose", schemas.POSE_COVARIANCE, "truth"),
        ("/weight/pose", schemas.POSE, "unknown"),
        ("/tf", schemas.TF, "estimate"),
        ("/vicon/tf", schemas.TF, "truth"),
        ("/tf", "foxglove.FrameTransforms", "estimate"),
    ],
)
def test_a_kind_follows_from_name_and_type(name, schema, kind):
    assert Topic(name, schema, "ros2msg", "cdr", 1, {}).pose_kind == kind


def test_a_stated_kind_counts_before_any_name():
    assert Topic("/ground_truth/pose", schemas.POSE, "ros2msg", "cdr", 1, {KIND_KEY: "estimate"}).pose_kind == "estimate"
