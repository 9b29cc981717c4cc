# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``python -m kfvo_ros.play`` in a process of its own, received by a node in this one."""

from __future__ import annotations

import signal
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest
from bag_writers import LATER_NS, START_NS, STORAGES, BagBuilder, Records
from command_lines import assert_one_readable_line, one_readable_line, run_python
from ros_processes import ENVIRONMENT, Listener, run_module, running_module, wait_until
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.typesys import get_types_from_msg
from sequence_writers import make_image, make_poses, pose_numbers

from kfvo_ros.trajectory import NANOSECONDS
from kfvo_ros.utils.process import time_limit

diagnostic_msgs = pytest.importorskip('diagnostic_msgs.msg')
geometry_msgs = pytest.importorskip('geometry_msgs.msg')
rosgraph_msgs = pytest.importorskip('rosgraph_msgs.msg')
sensor_msgs = pytest.importorskip('sensor_msgs.msg')

PLAY = 'kfvo_ros.play'
FRAMES = 12
FRAME_NS, IMU_NS = 50_000_000, 5_000_000
STAMPS_NS = [START_NS + FRAME_NS * index for index in range(FRAMES)]
POSES = make_poses(FRAMES)
CAM0, CAM1, IMU = '/cam0/image_raw', '/cam1/image_raw', '/imu0'
LEICA, VICON = '/leica/position', '/vicon/firefly_sbx/firefly_sbx'
EUROC = {CAM0: sensor_msgs.Image, CAM1: sensor_msgs.Image, IMU: sensor_msgs.Imu,
         LEICA: geometry_msgs.PointStamped, VICON: geometry_msgs.TransformStamped}


def stamp_ns(message) -> int:
    stamp = message.header.stamp
    return stamp.sec * NANOSECONDS + stamp.nanosec


def stamps(listener: Listener, topic: str) -> list[int]:
    return [stamp_ns(message) for message in listener.messages(topic)]


def imu(writer: BagBuilder, index: int):
    rates, zeros = np.array([0.1, -0.2, index / 3]), np.zeros(9)
    return writer.make('sensor_msgs/Imu', header=writer.header(START_NS + IMU_NS * index, 'imu'),
                       orientation=writer.quaternion((0, 0, 0, 1)), orientation_covariance=zeros,
                       angular_velocity=writer.point(rates, 'Vector3'),
                       angular_velocity_covariance=zeros,
                       linear_acceleration=writer.point((0, 0, 9.81), 'Vector3'),
                       linear_acceleration_covariance=np.arange(9.0))


def euroc_records(writer: BagBuilder) -> Records:
    """Return the messages of a EuRoC bag: no CameraInfo, ground truth on two topics."""
    records = [(IMU, START_NS + IMU_NS * index + LATER_NS, imu(writer, index))
               for index in range((FRAMES - 1) * FRAME_NS // IMU_NS)]
    for index, stamp in enumerate(STAMPS_NS):
        for topic, offset in ((CAM0, 0), (CAM1, 100)):
            records.append((topic, stamp + LATER_NS,
                            writer.image(stamp, make_image(index + offset), topic)))
        records.append((LEICA, stamp + LATER_NS, writer.point_stamped(stamp, POSES[index])))
        records.append((VICON, stamp + LATER_NS, writer.transform(stamp, POSES[index])))
    return records


@pytest.fixture(scope='module')
def bags(tmp_path_factory) -> dict[str, Path]:
    """Return a EuRoC bag in each storage."""
    folder = tmp_path_factory.mktemp('bags')
    return {storage: (writer := BagBuilder(storage)).write(folder / storage, euroc_records(writer))
            for storage in STORAGES}


def played(done: subprocess.CompletedProcess) -> list[str]:
    """Assert success; return the logged lines without those about lateness."""
    assert done.returncode == 0, done.stderr
    return [line for line in done.stderr.splitlines()
            if line.startswith('kfvo_play') and ' s late: ' not in line]


@pytest.mark.parametrize('storage', STORAGES)
def test_all_topics_but_the_second_camera_arrive_unchanged(storage, bags):
    with Listener(EUROC) as listener:
        lines = played(run_module(PLAY, bags[storage], '--wait-for-subscribers'))
        wait_until(lambda: len(listener.received) >= 3 * FRAMES + (FRAMES - 1) * 10)
    choice, = lines
    assert CAM0 in choice and choice.endswith(f'--topic plays others: {CAM1}')
    assert not listener.messages(CAM1)
    for topic in (CAM0, LEICA, VICON):
        assert stamps(listener, topic) == STAMPS_NS
    for index, image in enumerate(listener.messages(CAM0)):
        assert (image.encoding, image.height, image.width, image.step) == ('mono8', 24, 32, 32)
        assert image.header.frame_id == CAM0
        assert bytes(image.data) == make_image(index).tobytes()
    imu_messages = listener.messages(IMU)
    assert [stamp_ns(message) for message in imu_messages] == list(
        range(START_NS, START_NS + (FRAMES - 1) * FRAME_NS, IMU_NS))
    assert imu_messages[7].angular_velocity.z == 7 / 3
    assert list(imu_messages[7].linear_acceleration_covariance) == list(range(9))
    point, moved = listener.messages(LEICA)[5].point, listener.messages(VICON)[5]
    assert [point.x, point.y, point.z] == list(POSES[5, :3, 3])
    rotation = moved.transform.rotation
    assert [rotation.x, rotation.y, rotation.z, rotation.w] == list(pose_numbers(POSES[5])[3:])
    assert (moved.header.frame_id, moved.child_frame_id) == ('world', 'body')


def test_selected_topics_are_remapped_and_not_faster_than_the_rate(bags):
    with Listener({'/image': sensor_msgs.Image, **EUROC}) as listener:
        lines = played(run_module(
            PLAY, bags['ros1'], '--topic', 'cam1/image_raw', '--topic', IMU, '--rate', 0.5,
            '--wait-for-subscribers', 1, '--ros-args', '-r', f'{CAM1}:=/image'))
        wait_until(lambda: len(listener.messages('/image')) >= FRAMES)
    assert lines == []
    assert {topic for _, topic, _ in listener.received} == {'/image', IMU}
    assert bytes(listener.messages('/image')[0].data) == make_image(100).tobytes()
    arrivals = listener.arrivals('/image')
    assert -0.05 < arrivals[-1] - arrivals[0] - 2 * (FRAMES - 1) * FRAME_NS / 1e9 < 3.0


def test_start_and_duration(bags):
    with Listener(EUROC) as listener:
        played(run_module(PLAY, bags['mcap'], '--start', 0.1, '--duration', 0.2, '--rate', 2,
                          '--wait-for-subscribers'))
        wait_until(lambda: len(stamps(listener, VICON)) >= 4)
    assert stamps(listener, CAM0) == STAMPS_NS[2:6]
    assert stamps(listener, VICON) == STAMPS_NS[2:6]
    assert len(stamps(listener, IMU)) == 40


def test_loop_and_clock(bags):
    topics = {CAM0: sensor_msgs.Image, '/clock': rosgraph_msgs.Clock}
    with Listener(topics) as listener, running_module(
            PLAY, bags['sqlite3'], '--loop', '--clock', '100', '--wait-for-subscribers') as player:
        wait_until(lambda: len(listener.messages(CAM0)) >= 2 * FRAMES + 3)
        player.send_signal(signal.SIGINT)
        output, problems = player.communicate(timeout=time_limit(2.0))
    assert player.returncode == 0, problems
    assert 'loop 3' in problems and 'interrupted' in output
    played_stamps = stamps(listener, CAM0)
    assert played_stamps[:2 * FRAMES + 3] == STAMPS_NS * 2 + STAMPS_NS[:3]
    times = np.array([message.clock.sec * NANOSECONDS + message.clock.nanosec
                      for message in listener.messages('/clock')])
    assert (times >= START_NS + LATER_NS).all() and (times < START_NS + NANOSECONDS).all()
    back = np.flatnonzero(np.diff(times) <= 0)
    assert len(back) == 2  # only at the start of a loop
    assert (times[back + 1] < START_NS + LATER_NS + FRAME_NS).all()
    steps = np.delete(np.diff(times), back)
    assert 8e6 < np.median(steps) < 12e6  # 100 Hz


def qos(reliable: bool, latched: bool, depth: int = 5) -> Qos:
    forever = QosTime(2147483647, 4294967295)
    return Qos(QosHistory.KEEP_LAST, depth,
               QosReliability.RELIABLE if reliable else QosReliability.BEST_EFFORT,
               QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE,
               forever, forever, QosLiveliness.AUTOMATIC, forever, False)


@pytest.mark.parametrize('storage', STORAGES)
def test_recorded_qos_is_offered(storage, tmp_path):
    writer = BagBuilder(storage)
    writer.offers = {'/best': {'latching': 0}, '/latched': {'latching': 1}}
    if not writer.is_ros1:
        writer.offers = {'/best': {'offered_qos_profiles': [qos(False, False)]},
                         '/latched': {'offered_qos_profiles': [qos(True, True)]}}
    records = [(topic, START_NS + index * NANOSECONDS, writer.point_stamped(START_NS, POSES[0]))
               for index in range(60) for topic in ('/best', '/latched', '/default')]
    bag = writer.write(tmp_path / 'bag', records)
    with Listener({}) as listener, running_module(PLAY, bag):
        find = listener.node.get_publishers_info_by_topic
        topics = ('/best', '/latched', '/default')
        wait_until(lambda: all(map(find, topics)))
        offered = {topic: find(topic)[0].qos_profile for topic in topics}
    best = 'RELIABLE' if writer.is_ros1 else 'BEST_EFFORT'
    assert [(profile.reliability.name, profile.durability.name)
            for profile in offered.values()] == [
        (best, 'VOLATILE'), ('RELIABLE', 'TRANSIENT_LOCAL'), ('RELIABLE', 'VOLATILE')]


def test_best_effort_subscribers_receive_the_last_message(bags):
    from rclpy.qos import qos_profile_sensor_data
    with Listener({CAM0: sensor_msgs.Image}, qos_profile_sensor_data) as listener:
        played(run_module(PLAY, bags['mcap'], '--wait-for-subscribers'))
        wait_until(lambda: stamps(listener, CAM0)[-1:] == STAMPS_NS[-1:])


def test_unpublishable_topics_are_left_out(tmp_path):
    """Types that are not installed or differ in ROS 2 (Range has a variance there)."""
    writer = BagBuilder('ros1')
    writer.store.register(get_types_from_msg('uint8 level', 'acme_msgs/msg/Gadget'))
    reading = writer.make('sensor_msgs/Range', header=writer.header(START_NS), radiation_type=0,
                          field_of_view=1.0, min_range=0.0, max_range=9.0, range=3.0)
    prism = writer.point_stamped(START_NS, POSES[0])
    bag = writer.write(tmp_path / 'bag', [
        ('/gadget', START_NS, writer.make('acme_msgs/Gadget', level=1)),
        ('/range', START_NS + 1, reading), ('/prism/no-name', START_NS + 2, prism),
        ('/clock', START_NS + 2, writer.make('rosgraph_msgs/Clock', clock=prism.header.stamp)),
        ('/prism', START_NS + 3, prism)])
    with Listener({'/prism': geometry_msgs.PointStamped}) as listener:
        lines = played(run_module(PLAY, bag, '--wait-for-subscribers', '--clock'))
        wait_until(lambda: listener.messages('/prism'))
    assert sorted(line.partition('left out ')[2] for line in lines) == [
        '/clock (rosgraph_msgs/msg/Clock): --clock publishes there',
        '/gadget (acme_msgs/msg/Gadget): this ROS installation has no such messages',
        '/prism/no-name (geometry_msgs/msg/PointStamped): ROS 2 does not allow the name',
        '/range (sensor_msgs/msg/Range): this ROS installation has another definition of them']
    refused = one_readable_line(run_module(PLAY, bag, '--topic', '/gadget'))
    assert 'none of the topics can be published' in refused


@pytest.mark.parametrize('sent', [signal.SIGINT, signal.SIGTERM])
def test_interrupted_while_playing(sent, bags):
    with Listener({CAM0: sensor_msgs.Image}) as listener, running_module(
            PLAY, bags['ros1'], '--rate', '0.1') as player:
        wait_until(lambda: listener.received)
        player.send_signal(sent)
        output, problems = player.communicate(timeout=time_limit(2.0))
    assert player.returncode == 0, problems
    assert 'Traceback' not in problems
    assert 'messages published, interrupted at' in output


def test_waiting_for_subscribers_is_logged_and_can_be_interrupted(bags):
    with Listener({CAM0: sensor_msgs.Image}) as listener, running_module(
            PLAY, bags['ros1'], '--wait-for-subscribers', '2') as player:
        line = next(line for line in player.stderr if 'waiting' in line)
        assert f'waiting for 2 subscribers on {CAM0}' in line
        assert not listener.received
        player.send_signal(signal.SIGTERM)
        began = time.monotonic()
        _, problems = player.communicate(timeout=time_limit(10.0))
        assert time.monotonic() - began < time_limit(2.0)
    assert player.returncode == 0 and 'Traceback' not in problems


def test_waiting_for_processing_ends_when_the_node_is_idle(bags):
    """The node reports 5 images that wait, then none."""
    with Listener(EUROC) as listener, running_module(
            PLAY, bags['ros1'], '--wait-for-processing', '--rate', '10') as player:
        reports = listener.node.create_publisher(diagnostic_msgs.DiagnosticArray, '/diagnostics',
                                                 10)

        def report(waiting: int) -> None:
            values = {'images received': '12', 'images waiting': str(waiting)}
            reports.publish(diagnostic_msgs.DiagnosticArray(status=[
                diagnostic_msgs.DiagnosticStatus(name='kfvo: odometry', values=[
                    diagnostic_msgs.KeyValue(key=key, value=value)
                    for key, value in values.items()])]))
            time.sleep(0.05)

        wait_until(lambda: len(listener.messages(CAM0)) == FRAMES)
        for _ in range(20):
            report(5)
        assert player.poll() is None
        wait_until(lambda: report(0) or player.poll() is not None)
        assert player.returncode == 0


@pytest.mark.parametrize(('arguments', 'parts'), [
    (['{bag}', '--topic', '/nope'], ['/nope', f'its topics are: {CAM0}, {CAM1}, {IMU}']),
    (['/no/such.bag'], ['/no/such.bag does not exist']),
    (['{bag}', '--start', '1.5'], ['--start 1.5', 'lasts 0.5']),
    (['{bag}', '--topic', LEICA, '--start', '0.51', '--duration', '0.01'], ['no message', LEICA]),
    (['{bag}', '--rate', '0'], ['--rate', 'at least 0.001']),
    (['{bag}', '--rate', 'inf'], ['--rate', 'at most 1000']),
    (['--clock', '{bag}'], ['--clock', 'must not stand before']),
    (['{bag}', '--ros-args', '-r', 'nonsense'], ['ROS', 'nonsense']),
    ([__file__], ['cannot read the bag', __file__]),
])
def test_invalid_arguments_end_in_one_line(arguments, parts, bags):
    done = run_module(PLAY, *[text.format(bag=bags['ros1']) for text in arguments])
    assert_one_readable_line(done, *parts)


def test_a_bag_damaged_in_the_middle_is_played_up_to_there(bags, tmp_path):
    data = bytearray(bags['ros1'].read_bytes())
    middle = len(data) // 2
    data[middle:middle + 4000] = b'\xff' * 4000  # at least one message and its header
    (tmp_path / 'walk.bag').write_bytes(data)
    with Listener(EUROC) as listener:
        line = one_readable_line(run_module(PLAY, tmp_path / 'walk.bag', '--wait-for-subscribers'))
    assert 'cannot read the bag' in line and 'walk.bag' in line
    played_stamps = stamps(listener, CAM0)
    assert 0 < len(played_stamps) < FRAMES and played_stamps == STAMPS_NS[:len(played_stamps)]


def test_without_rclpy_one_line_shows_how_to_install_it(bags):
    code = ("import sys; sys.modules['rclpy'] = None; from kfvo_ros.play import main; "
            'sys.exit(main(sys.argv[1:]))')
    for arguments in ([], ['--ros-args', '-r', 'a:=b']):
        done = run_python('-c', code, bags['ros1'], *arguments, env=ENVIRONMENT)
        assert done.returncode == 1
        line, = done.stderr.splitlines()
        assert 'rclpy is missing: source /opt/ros/jazzy/setup.bash' in line
        assert "pip install 'kfvo_ros[ros]'" in line
