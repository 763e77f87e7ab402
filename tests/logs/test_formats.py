"""Logs in the formats of other programs, each written by that ecosystem's writer."""

import datetime
import sqlite3
import subprocess
import sys
from pathlib import Path

import h5py
import nptdms
import numpy as np
import openpyxl
import pandas
import pytest
import xarray
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from jaxid.errors import InputError
from jaxid.logs.in_memory import as_log
from jaxid.logs.log import read_log
from tests.support.lerobot_sets import lerobot
from tests.support.ros_bags import STORE, joint_state, nanoseconds, write_bag
from tests.support.written_logs import COLUMNS, refuse

SAMPLES = 300
T = np.arange(SAMPLES) / 500
Q, U = np.sin(5 * T), 2 * np.cos(5 * T)


def check(log, scale: float = 1.0) -> dict:
    np.testing.assert_allclose(log.time - log.time[0], T, atol=1e-9)
    np.testing.assert_allclose(log.position[:, 0], scale * Q, rtol=1e-12)
    np.testing.assert_allclose(log.force[:, 0], U, rtol=1e-12)
    return {a.setting: a for a in log.assumed}


# HDF5 and MATLAB 7.3


def test_hdf5_with_groups_and_units(tmp_path):
    with h5py.File(tmp_path / "log.h5", "w") as file:
        file["log/t"] = T
        file["log/axis/q"] = 1e3 * Q
        file["log/axis/q"].attrs["units"] = "mm"
        file["log/axis/u"] = U
        file["other/u"] = 0 * U
    columns = {"time": "t", "position": "log/axis/q", "force": "/log/axis/u"}
    said = check(read_log(tmp_path / "log.h5", columns))
    assert said["units.position"].value == "mm"
    refuse(tmp_path / "log.h5", COLUMNS, match="has 2 datasets 'u'; write 'log/axis/u'")


def test_hdf5_of_pandas_like_tables(tmp_path):
    table = np.zeros(SAMPLES, dtype=[("t", "f8"), ("q", "f8"), ("u", "f8")])
    table["t"], table["q"], table["u"] = T, Q, U
    with h5py.File(tmp_path / "log.hdf5", "w") as file:
        file["run/table"] = table
    check(read_log(tmp_path / "log.hdf5", COLUMNS))


def test_matlab_73(tmp_path):
    """A file as MATLAB writes it: 512 bytes of its header, then HDF5 whose matrices are transposed.

    No package writes it; the layout is that of MathWorks' "MAT-File Versions".
    """
    path = tmp_path / "log.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in {"t": T, "q": np.stack([Q, 2 * Q]), "u": U[None]}.items():
            file.create_dataset(name, data=np.atleast_2d(values)).attrs["MATLAB_class"] = np.bytes_("double")
        file.create_group("#refs#")
    text = b"MATLAB 7.3 MAT-file, Platform: GLNXA64, Created on: Mon Jan  1 00:00:00 2024 HDF5 schema 1.00 ."
    with path.open("r+b") as file:
        file.write(text.ljust(124) + b"\x00\x02IM")
    check(read_log(path, {**COLUMNS, "position": "q[1]"}))


# Excel


def workbook(path: Path, rows, title="Messung") -> Path:
    book = openpyxl.Workbook()
    book.active.append(["nothing here"])
    sheet = book.create_sheet(title)
    for row in rows:
        sheet.append(row)
    book.save(path)
    return path


def test_excel_with_metadata_units_and_sheets(tmp_path):
    rows = [["Antrieb", "X1"], [], ["t", "q", "u", "Bemerkung"], ["s", "mm", "N", ""]]
    rows += [[float(t), float(q), float(u), "ok"] for t, q, u in zip(T, Q, U, strict=True)]
    said = check(read_log(workbook(tmp_path / "log.xlsx", rows), COLUMNS), 1e-3)
    assert said["sheet"].value == "Messung"
    assert said["units.position"].value == "mm"
    refuse(
        tmp_path / "log.xlsx",
        {**COLUMNS, "force": "U"},
        match="no sheet has the column 'U'; did you mean 'u'",
    )


def test_excel_with_times_of_day_and_empty_cells(tmp_path):
    begin = datetime.datetime(2024, 2, 29, 23, 59, 59, 900_000)
    at = [begin + datetime.timedelta(milliseconds=2 * k) for k in range(SAMPLES)]
    rows = [["t", "q", "u"], *([a, float(q), float(u)] for a, q, u in zip(at, Q, U, strict=True))]
    rows[50][1] = None
    log = read_log(workbook(tmp_path / "log.xlsx", rows), COLUMNS)
    np.testing.assert_allclose(log.time, T, atol=1e-6)
    assert log.position[49, 0] == pytest.approx((Q[48] + Q[50]) / 2, rel=1e-9)
    rows[50][1] = "0,5"
    refuse(
        workbook(tmp_path / "log.xlsx", rows), match=r"column 'q', row 49 .*'0,5' is text; format the column"
    )


# TDMS


def test_tdms_with_a_channel_of_time(tmp_path):
    path = tmp_path / "log.tdms"
    with nptdms.TdmsWriter(path) as writer:
        q = nptdms.ChannelObject("axis", "q", 1e3 * Q, properties={"unit_string": "mm"})
        others = [nptdms.ChannelObject("axis", name, x) for name, x in {"t": T, "u": U}.items()]
        writer.write_segment([q, *others])
    assert check(read_log(path, {**COLUMNS, "force": "axis/u"}))["units.position"].value == "mm"


def test_tdms_with_waveforms_of_unequal_rate(tmp_path):
    path, fast = tmp_path / "log.tdms", np.arange(5 * SAMPLES) / 2500
    with nptdms.TdmsWriter(path) as writer:
        for name, t, x in (("q", fast, fast), ("u", T, U)):
            properties = {"wf_increment": float(t[1]), "wf_start_offset": 0.0, "wf_samples": t.size}
            writer.write_segment([nptdms.ChannelObject("axis", name, x, properties=properties)])
    log = read_log(path, {**COLUMNS, "time": "wf_time"})
    assert log.rate_hz == pytest.approx(500.0, rel=1e-4)
    np.testing.assert_allclose(log.position[:, 0], log.time, atol=1e-8)
    assert "resample" in {a.setting for a in log.assumed}


# LeRobot

EPISODES = [
    {"time": T, "state": np.stack([Q + k, 2 * Q], axis=1), "action": np.stack([U, 3 * U], axis=1)}
    for k in (0, 1)
]


LEROBOT = {"time": "timestamp", "position": "observation.state[elbow_flex.pos]", "force": "action[1]"}


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_lerobot(tmp_path, version):
    root = lerobot(tmp_path / "set", version, EPISODES)
    log = read_log(root, {**LEROBOT, "episode": 1})
    assert log.samples == SAMPLES
    # Numbers of the dataset are float32.
    np.testing.assert_allclose(log.position[:, 0], 2 * Q, atol=3e-7)
    np.testing.assert_allclose(log.force[:, 0], U, atol=3e-7)
    pan = {**LEROBOT, "position": "observation.state[1]", "episode": 1}
    np.testing.assert_allclose(read_log(root, pan).position[:, 0], Q + 1, atol=3e-7)
    refuse(root, LEROBOT, match="has 2 episodes; say episode = <number> in .log., one of 0 to 1")
    refuse(root, {**LEROBOT, "episode": 7}, match="has no episode 7")
    bad = {**LEROBOT, "position": "observation.state[elbow]", "episode": 0}
    refuse(root, bad, match="'observation.state' has no entry 'elbow'; there is: shoulder_pan.pos, elb")


def test_a_file_of_a_lerobot_dataset_is_its_episode(tmp_path):
    path = lerobot(tmp_path / "set", "v2.1", EPISODES) / "data" / "chunk-000" / "episode_000001.parquet"
    log = read_log(path, {**LEROBOT, "position": "observation.state[shoulder_pan.pos]"})
    np.testing.assert_allclose(log.position[:, 0], Q + 1, atol=3e-7)
    assert log.assumed[0].value == 1


# ROS


EPOCH = 1_700_000_000.0
ROS = {
    "time": "header.stamp",
    "position": "/joint_states.position[elbow]",
    "force": "/joint_states.effort[elbow]",
}


def joint_states(names=("shoulder", "elbow"), skew=lambda k: 0.0):
    for k, (t, q, u) in enumerate(zip(T, Q, U, strict=True)):
        message = joint_state(STORE, EPOCH + t, names, [0.0, q], [0.0, u])
        yield "/joint_states", "sensor_msgs/msg/JointState", EPOCH + t + 1e-4 + skew(k), message


def check_ros(log):
    np.testing.assert_allclose(log.time - log.time[0], T, atol=1e-6)
    np.testing.assert_allclose(log.position[:, 0], Q, rtol=1e-12)
    np.testing.assert_allclose(log.force[:, 0], U, rtol=1e-12)


@pytest.mark.parametrize("plugin", [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
def test_rosbag2(tmp_path, plugin):
    bag = write_bag(tmp_path / "bag", plugin, joint_states())
    check_ros(read_log(bag, ROS))
    one = next(p for p in bag.iterdir() if p.suffix in (".db3", ".mcap"))
    check_ros(read_log(one, ROS))
    refuse(bag, {**ROS, "force": "/joint_states.effort[elbw]"}, match="no entry 'elbw'; did you mean 'elbow'")
    refuse(
        bag,
        {**ROS, "force": "/joint.effort[elbow]"},
        match="has no topic '/joint'; did you mean '/joint_states'",
    )
    refuse(bag, {**ROS, "force": "/joint_states.torque"}, match="have no 'torque'; there is: header, name")
    refuse(bag, {**ROS, "time": "t"}, match='say time = "header.stamp"')


def states(stamps, recorded, position, topic="/joint_states"):
    """Yield joint states of one joint with stamps in nanoseconds."""
    for k, at in enumerate(stamps):
        message = joint_state(STORE, 0.0, ["elbow"], [position[k]], [1.0])
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(at, 10**9)
        yield topic, "sensor_msgs/msg/JointState", recorded[k] / 1e9, message


@pytest.mark.parametrize("time", ["header.stamp", "log_time"])
@pytest.mark.parametrize("topics", [1, 2])
def test_stamps_keep_their_nanoseconds(tmp_path, time, topics):
    """Seconds since 1970 as a float have steps of 0.2 us, and the other clock is years apart."""
    start = 1_700_000_000 * 10**9
    ticks = [100_007 * k for k in range(100)]
    at = [start + t for t in ticks]
    stamps = at if topics == 1 else [t - 1_600_000_000 * 10**9 for t in at]

    with Writer(tmp_path / "bag", version=8, storage_plugin=StoragePlugin.MCAP) as writer:
        for n in range(topics):
            connection = writer.add_connection(f"/arm{n}", "sensor_msgs/msg/JointState", typestore=STORE)
            for stamp, recorded, (_, kind, _, message) in zip(
                stamps, at, states(stamps, at, ticks), strict=True
            ):
                assert message.header.stamp.sec == stamp // 10**9
                writer.write(connection, recorded, STORE.serialize_cdr(message, kind))
    columns = {"time": time, "position": "/arm0.position", "force": f"/arm{topics - 1}.effort"}
    log = read_log(tmp_path / "bag", columns)
    np.testing.assert_allclose(log.time, np.array(ticks) / 1e9, rtol=0, atol=1e-12)


def test_nan_in_a_message_is_refused_unless_resample_is_stated(tmp_path):
    stamps = [nanoseconds(EPOCH + t) for t in T]
    position = np.where(np.arange(SAMPLES) == 7, np.nan, Q)
    bag = write_bag(tmp_path / "bag", StoragePlugin.MCAP, states(stamps, stamps, position))
    refuse(bag, ROS, match=r"1 row\(s\) are NaN or infinite, the first is row 7 \(NaN\)")
    log = read_log(bag, {**ROS, "resample": 500})
    np.testing.assert_allclose(log.position[:, 0], Q, atol=1e-3)


def test_a_record_of_no_clock_is_refused(tmp_path):
    stamps = [nanoseconds(EPOCH + t) for t in T]
    bag = write_bag(tmp_path / "bag", StoragePlugin.SQLITE3, states(stamps, stamps, Q))
    path = next(bag.glob("*.db3"))
    with sqlite3.connect(path) as database:
        database.execute("UPDATE messages SET timestamp = -5 WHERE id = 3")
    database.close()
    refuse(path, ROS, match="'/joint_states' was recorded at -5 ns since 1970, which no clock gives")


def test_a_bag_of_ros_1(tmp_path):
    store = get_typestore(Stores.ROS1_NOETIC)
    kind = "sensor_msgs/msg/JointState"
    with Writer1(tmp_path / "log.bag") as writer:
        connection = writer.add_connection("/joint_states", kind, typestore=store)
        for k, (t, q, u) in enumerate(zip(T, Q, U, strict=True)):
            message = joint_state(STORE, EPOCH + t, ["shoulder", "elbow"], [0.0, q], [0.0, u])
            header = store.types["std_msgs/msg/Header"](k, message.header.stamp, "base")
            old = store.types[kind](header, message.name, message.position, message.velocity, message.effort)
            writer.write(connection, nanoseconds(EPOCH + t), store.serialize_ros1(old, kind))
    check_ros(read_log(tmp_path / "log.bag", ROS))


def test_an_mcap_of_another_writer(tmp_path):
    """mcap-ros2-support, the writer of Foxglove, with the message's definition as text."""
    from mcap_ros2.writer import Writer as Foxglove

    definition = STORE.generate_msgdef("sensor_msgs/msg/JointState", ros_version=2)[0]
    path = tmp_path / "log.mcap"
    with path.open("wb") as file:
        writer = Foxglove(file)
        schema = writer.register_msgdef("sensor_msgs/msg/JointState", definition)
        for t, q, u in zip(T, Q, U, strict=True):
            stamp = {"sec": nanoseconds(EPOCH + t) // 10**9, "nanosec": nanoseconds(EPOCH + t) % 10**9}
            message = {
                "header": {"stamp": stamp, "frame_id": ""},
                "name": ["elbow"],
                "position": [q],
                "velocity": [],
                "effort": [u],
            }
            writer.write_message("/joint_states", schema, message, nanoseconds(EPOCH + t))
        writer.finish()
    check_ros(read_log(path, ROS))


def test_joints_are_found_by_name_when_their_order_changes(tmp_path):
    def messages():
        for k, (topic, kind, at, _) in enumerate(joint_states()):
            names = ["shoulder", "elbow"] if k % 3 else ["elbow", "shoulder"]
            values = [[0.0, Q[k]], [0.0, U[k]]] if k % 3 else [[Q[k], 0.0], [U[k], 0.0]]
            yield topic, kind, at, joint_state(STORE, EPOCH + T[k], names, *values)

    check_ros(read_log(write_bag(tmp_path / "bag", StoragePlugin.MCAP, messages()), ROS))


def test_topics_of_unequal_rate_and_a_clock_that_drifts(tmp_path):
    """Joint states of a computer that is 2 s ahead and 200 ppm fast; commands without stamps at 100 Hz."""
    float64 = STORE.types["std_msgs/msg/Float64MultiArray"]
    layout = STORE.types["std_msgs/msg/MultiArrayLayout"]([], 0)
    t = np.arange(20_000) / 500
    rng = np.random.default_rng(0)
    delays = rng.exponential(5e-4, t.size)

    def messages():
        for k, at in enumerate(t):
            stamp = EPOCH + 2.0 + at * (1 + 2e-4)
            message = joint_state(STORE, stamp, ["elbow"], [np.sin(at)])
            yield "/joint_states", "sensor_msgs/msg/JointState", EPOCH + at + delays[k], message
            if k % 5 == 0:
                command = float64(layout, np.array([7.0, np.cos(at)]))
                yield "/command", "std_msgs/msg/Float64MultiArray", EPOCH + at, command

    bag = write_bag(tmp_path / "bag", StoragePlugin.MCAP, sorted(messages(), key=lambda m: m[2]))
    columns = {
        "time": "header.stamp",
        "position": "/joint_states.position[elbow]",
        "force": "/command.data[2]",
    }
    log = read_log(bag, columns)
    assert log.rate_hz == pytest.approx(100.0, rel=1e-3)
    said = {a.setting: a for a in log.assumed}
    assert "drift by -200 ppm" in said["clock"].reason
    assert "have no stamp" in said["time"].reason
    # The smallest of 2000 delays is below a microsecond; the start is that of the first message recorded.
    np.testing.assert_allclose(log.position[:, 0], np.sin(log.time), atol=1e-4)
    np.testing.assert_allclose(log.force[:, 0], np.cos(log.time), atol=1e-4)


@pytest.mark.parametrize("suffix", ["h5", "xlsx", "tdms", "mcap", "db3", "bag"])
def test_garbage_is_refused_in_one_line(tmp_path, suffix):
    path = tmp_path / f"log.{suffix}"
    path.write_bytes(b"this is no such file, whatever it is called" * 10)
    columns = ROS if suffix in ("mcap", "db3", "bag") else COLUMNS
    refuse(path, columns, match="cannot be read")


def written(folder: Path, suffix: str) -> tuple[Path, dict]:
    """Return a sound file of a format, and its columns."""
    table = {"t": T, "q": Q, "u": U}
    path = folder / f"sound.{suffix}"
    if suffix == "h5":
        with h5py.File(path, "w") as file:
            for name, values in table.items():
                file[name] = values
    elif suffix == "xlsx":
        workbook(path, [list(table), *zip(T.tolist(), Q.tolist(), U.tolist(), strict=True)])
    elif suffix == "tdms":
        with nptdms.TdmsWriter(path) as writer:
            writer.write_segment([nptdms.ChannelObject("log", name, x) for name, x in table.items()])
    else:
        plugin = StoragePlugin.MCAP if suffix == "mcap" else StoragePlugin.SQLITE3
        bag = write_bag(folder / "bag", plugin, joint_states())
        return next(p for p in bag.iterdir() if p.suffix == f".{suffix}"), ROS
    return path, COLUMNS


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("suffix", ["h5", "xlsx", "tdms", "mcap", "db3"])
def test_a_damaged_file_is_read_or_refused(tmp_path, suffix):
    sound, columns = written(tmp_path, suffix)
    content, path = sound.read_bytes(), tmp_path / f"log.{suffix}"
    outcomes = set()
    for seed in range(40):
        random = np.random.default_rng(seed)
        damaged = bytearray(content)
        for k in random.integers(len(damaged), size=2):
            damaged[k] = random.integers(256)
        head = random.integers(min(400, len(damaged)))
        damaged[head] = random.integers(256)
        path.write_bytes(damaged[: random.integers(len(damaged))] if seed % 4 == 0 else damaged)
        try:
            read_log(path, columns)
            line = ""
        except InputError as error:
            line = str(error)
        outcomes.add("refused" if line else "read")
        assert "\n" not in line
        assert len(line) < 1000
    assert "refused" in outcomes


@pytest.mark.parametrize(
    ("suffix", "module", "package"),
    [
        ("h5", "h5py", "h5py"),
        ("xlsx", "openpyxl", "openpyxl"),
        ("tdms", "nptdms", "npTDMS"),
        ("mcap", "rosbags.highlevel", "rosbags"),
    ],
)
def test_a_missing_library_is_named(tmp_path, monkeypatch, suffix, module, package):
    (tmp_path / f"log.{suffix}").write_bytes(b"x")
    monkeypatch.setitem(sys.modules, module, None)
    refuse(tmp_path / f"log.{suffix}", ROS, match=f"needs {package}; pip install {package}, or .*jaxid.logs.")


def test_the_format_may_be_stated(tmp_path):
    pandas.DataFrame({"t": T, "q": Q, "u": U}).to_csv(tmp_path / "log.out", index=False)
    check(read_log(tmp_path / "log.out", {**COLUMNS, "format": "csv"}))
    refuse(tmp_path / "log.out", match="unknown suffix '.out'; .*or say format")
    refuse(
        tmp_path / "log.out",
        {**COLUMNS, "format": "cvs"},
        match="format = 'cvs' is unknown; did you mean 'csv'",
    )


def test_the_units_of_a_dataset_count():
    data = xarray.Dataset({"q": ("t", 1e3 * Q, {"units": "mm"}), "u": ("t", U)}, coords={"t": T})
    assert check(as_log(data, COLUMNS))["units.position"].value == "mm"


@pytest.mark.parametrize("zone", [None, "Europe/Berlin"])
def test_an_index_of_dates_is_time_in_seconds(tmp_path, zone):
    index = pandas.Timestamp("2024-03-31 00:59:59.8", tz=zone) + pandas.to_timedelta(T, unit="s")
    frame = pandas.DataFrame({"q": Q, "u": U}, index=index.rename("t"))
    check(as_log(frame, COLUMNS))
    frame.to_parquet(tmp_path / "log.parquet")
    check(read_log(tmp_path / "log.parquet", COLUMNS))


def test_tables_in_memory_have_their_units():
    data = xarray.Dataset({"q": ("t", 1e3 * Q), "u": ("t", U)}, coords={"t": T})
    check(as_log(data, {**COLUMNS, "units": {"position": "mm"}}))
    check(as_log(pandas.DataFrame({"t": 1e3 * T, "q": Q, "u": U}), {**COLUMNS, "units": {"time": "ms"}}))


MEASURE = """
import sys, time
from jaxid.logs.log import read_log
columns = {"time": "header.stamp", "position": "/joint_states.position[elbow]"}
columns["force"] = "/joint_states.effort[elbow]"
def peak():
    # The peak of getrusage is at least that of the process that started this one.
    [line] = [line for line in open("/proc/self/status") if line.startswith("VmHWM")]
    return 1024 * int(line.split()[1])
read_log(sys.argv[2], columns)
before, start = peak(), time.perf_counter()
log = read_log(sys.argv[1], columns)
print(time.perf_counter() - start, peak() - before, log.samples)
"""


@pytest.mark.slow
def test_a_tenth_of_an_hour_at_1_khz(tmp_path):
    """An hour is to be read in 90 s, with memory of at most twice the file."""
    count = 360_000

    def messages(many):
        for k in range(many):
            message = joint_state(STORE, EPOCH + k * 1e-3, ["shoulder", "elbow"], [0.0, k * 1e-6], [0.0, 1.0])
            yield "/joint_states", "sensor_msgs/msg/JointState", EPOCH + k * 1e-3, message

    large = write_bag(tmp_path / "large", StoragePlugin.MCAP, messages(count))
    small = write_bag(tmp_path / "small", StoragePlugin.MCAP, messages(1000))
    command = [sys.executable, "-c", MEASURE, str(large), str(small)]
    runs = [subprocess.run(command, check=True, capture_output=True, text=True).stdout for _ in range(2)]
    seconds, memory, samples = np.array([run.split() for run in runs], dtype=float).min(axis=0)
    print(f"{seconds:.1f} s, {memory / 1e6:.0f} MB")
    assert samples == count
    assert seconds < 9.0
    assert memory < 2 * sum(p.stat().st_size for p in large.iterdir())
