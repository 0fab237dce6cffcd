"""Which topics are proposed, why, and what they are estimated to take."""

from dataclasses import replace

import pytest

from ros2_memory.cli.proposal import (
    Choice,
    Disk,
    Offered,
    judge,
    propose,
    select,
)

DISK = Disk(
    ratio=0.5,
    fixed_bytes=20_000,
    split_s=10,
    session_s=600,
    columns_share=0.0,
    budget_bytes=5e9,
    keep_days=7,
)
ODOM = Offered("/odom", "nav_msgs/msg/Odometry", messages=250, hz=50.0, payload_bytes=700.0)
SCAN = Offered("/scan", "sensor_msgs/msg/LaserScan", messages=50, hz=10.0, payload_bytes=9000.0)


TOPICS = {
    (Choice.LEAVE, "images"): [
        "/camera/image_raw sensor_msgs/msg/Image",
        "/camera/image_raw/compressed sensor_msgs/msg/CompressedImage",
        "/camera/image_raw/ffmpeg ffmpeg_image_transport_msgs/msg/FFMPEGPacket",
        "/camera/image_raw/theora theora_image_transport/msg/Packet",
        "/video foxglove_msgs/msg/CompressedVideo",
        "/disparity stereo_msgs/msg/DisparityImage",
    ],
    (Choice.LEAVE, "clouds"): [
        "/points sensor_msgs/msg/PointCloud2",
        "/octomap_full octomap_msgs/msg/Octomap",
        "/lidar livox_ros_driver2/msg/CustomMsg",
    ],
    (Choice.LEAVE, "costmaps"): [
        "/local_costmap/costmap_raw nav2_msgs/msg/Costmap",
        "/global_costmap/costmap nav_msgs/msg/OccupancyGrid",
        "/local_costmap/costmap_updates map_msgs/msg/OccupancyGridUpdate",
        "/elevation grid_map_msgs/msg/GridMap",
    ],
    (Choice.LEAVE, "audio"): [
        "/mic audio_common_msgs/msg/AudioData",
        "/speech/audio audio_common_msgs/msg/AudioStamped",
        "/robot/audio/raw std_msgs/msg/UInt8MultiArray",
    ],
    (Choice.LEAVE, "segmentation masks"): [
        "/vision/masks my_msgs/msg/InstanceMasks",
    ],
    (Choice.LEAVE, "the same calibration"): [
        "/camera/camera_info sensor_msgs/msg/CameraInfo",
    ],
    (Choice.LEAVE, "drawings"): [
        "/markers visualization_msgs/msg/MarkerArray",
    ],
    (Choice.LEAVE, "beats"): [
        "/bond bond/msg/Status",
        "/clock rosgraph_msgs/msg/Clock",
    ],
    (Choice.ASK, "what people said"): [
        "/speech std_msgs/msg/String",
        "/head/speech_to_text std_msgs/msg/String",
        "/asr/result std_msgs/msg/String",
        "/audio/transcript std_msgs/msg/String",
        "/humans/voices/v1 hri_msgs/msg/LiveSpeech",
        "/utterances my_msgs/msg/Utterance",
    ],
    (Choice.RECORD, ""): [
        "/odom nav_msgs/msg/Odometry",
        "/tf_static tf2_msgs/msg/TFMessage",
        "/vision/find_object/detections_meta ros2_vision_interfaces/msg/VisionDetectionArray",
        "/vision/find_object/detections ros2_vision_interfaces/msg/VisionDetectionArray",
        "/navigate_to_pose/_action/status action_msgs/msg/GoalStatusArray",
        "/chatter std_msgs/msg/String",
        "/imagery_count std_msgs/msg/Int32",
        "/battery_state sensor_msgs/msg/BatteryState",
    ],
}
"""Topics with their types, by what becomes of them, and how the reason for it begins."""


@pytest.mark.parametrize(("choice", "reason"), TOPICS)
def test_a_topic_is_judged_by_its_name_and_type(choice: Choice, reason: str) -> None:
    for topic in TOPICS[choice, reason]:
        name, kind = topic.split()
        offered = Offered(name, kind, latched=choice is Choice.LEAVE)
        verdict = judge([offered])[offered]
        assert verdict.choice is choice, topic
        assert verdict.reason.startswith(reason), topic
        assert bool(verdict.reason) is bool(reason)


def test_detections_with_masks_are_left_beside_those_with_metadata() -> None:
    kind = "ros2_vision_interfaces/msg/VisionDetectionArray"
    masks = Offered("/vision/find_object/detections", kind)
    meta = replace(masks, topic=f"{masks.topic}_meta")
    verdicts = judge([masks, meta])
    assert verdicts[masks].choice is Choice.LEAVE
    assert verdicts[masks].reason == f"masks: {meta.topic} has the same without"
    assert verdicts[meta].choice is Choice.RECORD


def test_a_map_is_proposed_where_it_is_latched_and_came_once() -> None:
    once = Offered("/map", "nav_msgs/msg/OccupancyGrid", latched=True, messages=1)
    for offered, choice in (
        (once, Choice.RECORD),
        (replace(once, messages=3), Choice.LEAVE),
        (replace(once, latched=False), Choice.LEAVE),
    ):
        assert judge([offered])[offered].choice is choice


def test_a_message_takes_its_payload_and_what_mcap_adds() -> None:
    one = Offered("/a", "a/msg/A", messages=5, hz=1.0, payload_bytes=69.0)
    # (69 + 31) / 2 compressed, and 16 of an index, in each of 86,400 s.
    assert DISK.bytes_per_day([one]) == pytest.approx(86_400 * 66)
    assert DISK.bytes_per_day([one, one]) == pytest.approx(2 * 86_400 * 66)
    assert replace(DISK, columns_share=0.5).bytes_per_day([one]) == pytest.approx(86_400 * 99)


def test_files_take_their_definitions_and_a_list_of_those_before() -> None:
    # 8,640 files of 20,000 bytes; a recording has 60, each of which lists 30 others on average.
    assert DISK.file_bytes_per_day == pytest.approx(8640 * (20_000 + 30 * 342))
    assert replace(DISK, split_s=20).file_bytes_per_day < DISK.file_bytes_per_day / 2


def test_scans_are_left_out_where_the_list_does_not_fit_because_of_them() -> None:
    large = replace(DISK, budget_bytes=100e9)
    assert propose([ODOM, SCAN], large)[SCAN].choice is Choice.RECORD
    left = propose([ODOM, SCAN], DISK)
    assert select(left, Choice.RECORD) == [ODOM]
    assert left[SCAN].choice is Choice.LEAVE
    assert left[SCAN].reason == "70% of a list of which the budget would hold 0.9 days"
