# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Inputs of kfvo_node: QoS, encodings, invalid images, calibrations."""

from __future__ import annotations

import time

import cv2
import numpy as np
import pytest
from node_rig import (
    BEST_EFFORT,
    DIAGNOSTICS,
    HEIGHT,
    IMAGE,
    INFO,
    RELIABLE,
    WARN,
    WIDTH,
    Rig,
    is_origin,
    make_frames,
    rosgraph_msgs,
    sensor_msgs,
    stamp_ns,
    stamped,
    to_image,
    to_info,
    to_pose,
)
from ros_processes import Listener, wait_until

from kfvo_ros import geometry
from kfvo_ros.odometry.base_motion import T_BODY_OPTICAL, base_pose
from kfvo_ros.odometry.factory import make_odometry
from kfvo_ros.odometry.options import OdometryOptions
from kfvo_ros.sequences.base import Frame
from kfvo_ros.sequences.calibration import write_camera_info
from kfvo_ros.trajectory import NANOSECONDS

FRAMES = make_frames()
CAMERA = FRAMES[0].camera


@pytest.mark.parametrize('qos', [RELIABLE, BEST_EFFORT], ids=['reliable', 'best_effort'])
@pytest.mark.parametrize('late_camera', [False, True], ids=['before', 'after'])
def test_a_camera_of_either_reliability_that_starts_before_or_after(qos, late_camera):
    with Rig(qos=qos, late_camera=late_camera) as rig:
        if late_camera:
            time.sleep(0.3)  # the node has searched without finding a publisher
            rig.start_camera()
            rig.wait_for_subscriber()
        reliability = qos.reliability.name.lower()
        rig.wait_for_line(f'subscribed to {IMAGE} ({reliability}, as its publisher)')
        rig.send_until_odometry(FRAMES[:5])
        assert is_origin(rig.odometry(1)[0])


def test_a_best_effort_camera_joins_a_reliable_one():
    """The requested reliability is lowered while the node runs."""
    with Rig() as rig:
        rig.run(FRAMES[:2])
        rig._qos = BEST_EFFORT
        rig.start_camera()
        rig.wait_for_line('subscribing again')
        rig.wait_for_line(f'subscribed to {IMAGE} (best_effort, as its publisher')
        rig.wait_for_subscriber()
        before = len(rig.odometry())
        for frame in FRAMES[2:30]:
            rig.send([frame])
            time.sleep(0.02)
        wait_until(lambda: len(rig.odometry()) > before + 3)


def test_reliable_subscription_to_a_best_effort_camera_logs_the_remedy():
    with Rig(qos=BEST_EFFORT, late_camera=True, image_qos='reliable') as rig:
        rig.start_camera()
        line = rig.wait_for_line('does not offer the requested reliability')
        assert '[ERROR]' in line and IMAGE in line and 'set image_qos to auto' in line


@pytest.mark.parametrize('topic', [f'{IMAGE}/compressed', '/camera/jpeg'])
def test_compressed_images_on_a_topic_of_any_name(topic):
    with Rig(sensor_msgs.CompressedImage, topic) as rig:
        for frame in FRAMES[:6]:
            rig.info.publish(to_info(CAMERA, frame.stamp_ns))
            message = sensor_msgs.CompressedImage(
                format='mono8; png compressed mono8',
                data=cv2.imencode('.png', frame.image)[1].tobytes())
            rig.image.publish(stamped(message, frame.stamp_ns))
        compressed = [to_pose(message.pose.pose) for message in rig.odometry(6)]
    with Rig() as rig:
        raw = [to_pose(message.pose.pose) for message in rig.run(FRAMES[:6])]
    np.testing.assert_allclose(compressed, raw, atol=1e-9)  # PNG is lossless


def test_a_camera_that_restarts_with_another_type():
    with Rig() as rig, Listener({}) as other:
        rig.run(FRAMES[:3])
        rig.listener.node.destroy_publisher(rig.image)
        camera = other.node.create_publisher(sensor_msgs.CompressedImage, IMAGE, RELIABLE)
        wait_until(camera.get_subscription_count)
        data = cv2.imencode('.png', FRAMES[3].image)[1].tobytes()
        camera.publish(stamped(sensor_msgs.CompressedImage(format='png', data=data),
                               FRAMES[3].stamp_ns))
        assert stamp_ns(rig.odometry(4)[-1]) == FRAMES[3].stamp_ns


def encoded(image: np.ndarray) -> list[tuple[str, np.ndarray, int]]:
    """Return (encoding, rows of bytes, is big-endian) of a grey image in every encoding."""
    colour, opaque = np.repeat(image[..., None], 3, 2), np.full((*image.shape, 1), 255, np.uint8)
    with_alpha, noise = np.concatenate([colour, opaque], 2), image[::-1, ::-1]
    neutral = np.stack([np.full_like(image, 128), image], 2)
    little, big = np.stack([noise, image], 2), np.stack([image, noise], 2)
    rows = [('mono8', image, 0), ('8UC1', image, 0), ('rgb8', colour, 0), ('bgr8', colour, 0),
            ('rgba8', with_alpha, 0), ('bgra8', with_alpha, 0), ('bayer_rggb8', image, 0),
            ('bayer_gbrg8', image, 0), ('mono16', little, 0), ('mono16', big, 1),
            ('16UC1', little, 0), ('yuv422', neutral, 0),
            ('mono8', np.pad(image, ((0, 0), (0, 24))), 0)]
    return [(name, pixels.reshape(len(image), -1), big) for name, pixels, big in rows]


def test_all_encodings_give_the_same_poses():
    """One camera that changes its encoding with every image."""
    count = len(encoded(FRAMES[0].image))
    with Rig() as rig:
        rig.info.publish(to_info(CAMERA))
        for index, frame in enumerate(FRAMES[:count]):
            name, rows, is_bigendian = encoded(frame.image)[index]
            rig.image.publish(to_image(frame.stamp_ns, rows, name, width=WIDTH,
                                       is_bigendian=is_bigendian))
        mixed = rig.odometry(count)
        rig.wait_for_value('images processed', count)
        values = rig.state()[2]
        assert (values['images refused'], values['frames lost']) == ('0', '0')
    assert [stamp_ns(message) for message in mixed] == [
        frame.stamp_ns for frame in FRAMES[:count]]
    with Rig() as rig:
        grey = [to_pose(message.pose.pose)[:3, 3] for message in rig.run(FRAMES[:count])]
    positions = np.array([to_pose(message.pose.pose)[:3, 3] for message in mixed])
    # Demosaicing smooths grey; the other encodings change nothing.
    assert np.abs(positions - grey).max() < 0.05 * np.linalg.norm(grey[-1])


def invalid_images(stamp: int, image: np.ndarray) -> list:
    """Return messages that are not images."""
    return [to_image(stamp, image, **fields) for fields in (
        {'data': []}, {'encoding': 'nonsense'}, {'encoding': ''}, {'step': 500},
        {'step': 2 ** 31}, {'width': 0, 'height': 0, 'step': 0, 'data': []}, {'height': 0},
        {'width': 2 ** 32 - 1}, {'encoding': 'rgb8'}, {'height': HEIGHT + 1})]


def test_invalid_images_are_refused_and_counted():
    bad = invalid_images(FRAMES[3].stamp_ns, FRAMES[3].image)
    with Rig() as rig:
        rig.run(FRAMES[:3])
        for message in bad:
            rig.image.publish(message)
        rig.wait_for_value('images refused', len(bad))
        level, summary, _ = rig.state()
        assert level == WARN and 'expected a' in summary
        assert '[ERROR]' in rig.wait_for_line('[kfvo]: expected a 320x240 mono8 image')
        after = rig.run(FRAMES[3:6])
        assert not is_origin(after[0])  # no reset
        rig.wait_for_value('images processed', 6)
        assert rig.state()[0] == 0
        # A second image of the same stamp is left out.
        rig.send([FRAMES[5]])
        rig.wait_for_value('images late', 1)
        assert rig.state()[0] == WARN and 'left out the image of stamp' in rig.state()[1]


def test_a_clock_message_that_goes_back_resets_at_once():
    """A looped bag with --clock: the first image of the second loop is the origin."""
    with Rig(use_sim_time=True) as rig:
        clock = rig.listener.node.create_publisher(rosgraph_msgs.Clock, '/clock', 10)
        wait_until(clock.get_subscription_count)

        def show(stamp: int) -> None:
            message = rosgraph_msgs.Clock()
            message.clock.sec, message.clock.nanosec = divmod(stamp, NANOSECONDS)
            clock.publish(message)
            wait_until(lambda: stamp_ns(rig.listener.messages(DIAGNOSTICS)[-1]) == stamp)

        wait_until(lambda: rig.listener.messages(DIAGNOSTICS))
        rig.run(FRAMES[1:8])
        show(FRAMES[7].stamp_ns)
        show(FRAMES[1].stamp_ns)
        rig.send(FRAMES[1:3])
        messages = rig.odometry(9)
        assert [stamp_ns(message) for message in messages[7:]] == [
            frame.stamp_ns for frame in FRAMES[1:3]]
        assert [index for index, message in enumerate(messages) if is_origin(message)] == [0, 7]
        rig.wait_for_value('resets', 1)


def test_another_resolution_resets():
    large = [Frame(frame.stamp_ns, cv2.resize(frame.image, (2 * WIDTH, 2 * HEIGHT)),
                   CAMERA.scaled(2 * WIDTH, 2 * HEIGHT)) for frame in FRAMES[6:10]]
    with Rig() as rig:
        rig.run(FRAMES[:6])
        messages = rig.run(large)
        assert [is_origin(message) for message in messages] == [True, False, False, False]
        rig.wait_for_line('restarting at the origin: the calibration changed')
        rig.wait_for_line('images of 640x480, fx 400.0')
        rig.wait_for_value('resets', 1)


def test_alternating_resolutions_are_a_warning_and_a_few_lines():
    large = CAMERA.scaled(2 * WIDTH, 2 * HEIGHT)
    with Rig() as rig:
        rig.info.publish(to_info(CAMERA))
        for index, frame in enumerate(FRAMES[:16]):
            rig.send([frame if index % 2 else Frame(
                frame.stamp_ns, cv2.resize(frame.image, (2 * WIDTH, 2 * HEIGHT)), large)],
                with_info=False)
        rig.odometry(16)
        rig.wait_for_value('resets', 15)
        assert rig.state()[:2] == (WARN, '3 resets within 60 s')
        assert sum('images of' in line for line in rig.lines) <= 4
        assert sum('restarting at the origin' in line for line in rig.lines) == 1


def test_without_calibration_it_waits_and_logs_both_remedies():
    with Rig() as rig:
        rig.send(FRAMES[:3], with_info=False)
        line = rig.wait_for_line('no calibration')
        assert INFO in line and 'camera_info_topic' in line and 'camera_info_file' in line
        rig.wait_for_value('images refused', 3)
        assert rig.state()[0] == WARN and not rig.odometry()
        uncalibrated = to_info(CAMERA)
        uncalibrated.k = np.zeros(9)
        rig.info.publish(uncalibrated)
        time.sleep(0.2)
        rig.send(FRAMES[3:4], with_info=False)
        rig.wait_for_value('images refused', 4)
        assert 'uncalibrated' in rig.state()[1]
        rig.info.publish(to_info(CAMERA))
        time.sleep(0.2)
        rig.send(FRAMES[4:6], with_info=False)
        assert [stamp_ns(message) for message in rig.odometry(2)] == [
            frame.stamp_ns for frame in FRAMES[4:6]]


def test_a_calibration_file_takes_precedence_over_the_topic(tmp_path):
    write_camera_info(tmp_path / 'camera.yaml', CAMERA)
    with Rig(camera_info_file=tmp_path / 'camera.yaml') as rig:
        rig.send(FRAMES[:4], with_info=False)
        assert len(rig.odometry(4)) == 4
        assert str(tmp_path / 'camera.yaml') in rig.wait_for_line('images of 320x240')
        assert rig.info.get_subscription_count() == 0


def test_camera_info_of_another_size_is_scaled_to_the_image():
    """The driver resizes its images and publishes the calibration of the whole sensor."""
    with Rig() as rig:
        rig.info.publish(to_info(CAMERA.scaled(2 * WIDTH, 2 * HEIGHT)))
        rig.send(FRAMES[:8], with_info=False)
        resized = [to_pose(message.pose.pose) for message in rig.odometry(8)]
        rig.wait_for_line(f'images of {WIDTH}x{HEIGHT}, fx {CAMERA.fx:.1f}, fy {CAMERA.fy:.1f}')
        rig.wait_for_value('images refused', 0)
    odometry = make_odometry(OdometryOptions())
    expected = [base_pose(odometry.process(frame).T_world_camera, T_BODY_OPTICAL)
                for frame in FRAMES[:8]]
    np.testing.assert_allclose(resized, expected, atol=1e-6)
    assert np.abs(expected[-1] - np.eye(4)).max() > 0.01


def test_camera_info_of_another_aspect_ratio_is_refused():
    """It belongs to a crop, whose place in the image is unknown; a right one is used at once."""
    cropped = to_info(CAMERA)
    cropped.height = HEIGHT - 40
    with Rig() as rig:
        rig.info.publish(cropped)
        rig.send(FRAMES[:3], with_info=False)
        line = rig.wait_for_line('[ERROR]')
        problem = (f'CameraInfo on {INFO}: the calibration is for {WIDTH}x{HEIGHT - 40} '
                   f'images, {WIDTH}x{HEIGHT} came; '
                   'give the calibration of these images')
        assert problem in line
        rig.wait_for_value('images refused', 3)
        assert rig.state()[:2] == (WARN, problem)
        assert not rig.odometry()
        rig.info.publish(to_info(CAMERA))
        time.sleep(0.2)
        rig.send(FRAMES[3:6], with_info=False)
        messages = rig.odometry(3)
        assert [stamp_ns(message) for message in messages] == [
            frame.stamp_ns for frame in FRAMES[3:6]]
        assert is_origin(messages[0])
        rig.wait_for_value('images processed', 3)
        assert rig.state()[2]['images refused'] == '3' and rig.state()[0] == 0


def test_rectified_images_use_p_without_distortion():
    """K and D belong to the raw image; R rotates it to the rectified one."""
    info = to_info(CAMERA)
    info.k = np.diag([1.5, 1.4, 1.0]).dot(CAMERA.matrix).ravel()
    info.d = [-0.3, 0.1, 0.01, -0.01, 0.0]
    info.r = geometry.exp_so3(np.array([0.02, -0.03, 0.01])).ravel()
    found = {}
    for topic in ('/camera/image_rect', IMAGE):
        with Rig(topic=topic) as rig:
            rig.info.publish(info)
            rig.send(FRAMES[:8], with_info=False)
            found[topic] = [to_pose(message.pose.pose) for message in rig.odometry(8)]
            rig.wait_for_line('none distortion' if 'rect' in topic else 'plumb_bob distortion')
    odometry = make_odometry(OdometryOptions())
    ideal = [base_pose(odometry.process(frame).T_world_camera, T_BODY_OPTICAL)
             for frame in FRAMES[:8]]
    np.testing.assert_allclose(found['/camera/image_rect'], ideal, atol=1e-9)
    assert np.abs(np.array(found[IMAGE]) - ideal).max() > 1e-3  # the effect of K and D
