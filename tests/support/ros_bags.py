"""Recordings of ROS 2, written by rosbags."""

import numpy as np
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_typestore

STORE = get_typestore(Stores.ROS2_HUMBLE)


def nanoseconds(t: float) -> int:
    return round(t * 1e9)


def joint_state(store, t, names, position, effort=()):
    kinds = store.types
    stamp = kinds["builtin_interfaces/msg/Time"](nanoseconds(t) // 10**9, nanoseconds(t) % 10**9)
    return kinds["sensor_msgs/msg/JointState"](
        kinds["std_msgs/msg/Header"](stamp, "base"),
        list(names),
        np.array(position, dtype=np.float64),
        np.zeros(0),
        np.array(effort, dtype=np.float64),
    )


def write_bag(path, plugin, messages, version=8):
    """Write (topic, type, recorded, message) with the rosbag2 writer."""
    with Writer(path, version=version, storage_plugin=plugin) as writer:
        connections = {}
        for topic, kind, recorded, message in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=STORE)
            raw = STORE.serialize_cdr(message, kind)
            writer.write(connections[topic], nanoseconds(recorded), raw)
    return path
