"""LeRobot datasets in the layouts of v2.1 and v3.0, as lerobot publishes them; its writer needs PyTorch."""

import json
from pathlib import Path

import numpy as np
import pyarrow
from pyarrow import parquet

MOTORS = ["shoulder_pan.pos", "elbow_flex.pos"]


def lerobot(root: Path, version: str, episodes, kind="float32") -> Path:
    feature = {"dtype": kind, "shape": [2], "names": MOTORS}
    named = {"motors": MOTORS} if version == "v2.1" else MOTORS
    features = {name: {**feature, "names": named} for name in ("observation.state", "action")}
    scalars = ("timestamp", "frame_index", "episode_index", "index", "task_index")
    features |= {name: {"dtype": kind, "shape": [1], "names": None} for name in scalars}
    paths = {"v2.1": "episode_{episode_index:06d}", "v3.0": "file-{file_index:03d}"}
    info = {
        "codebase_version": version,
        "robot_type": "so101_follower",
        "total_episodes": len(episodes),
        "fps": 500,
        "data_path": f"data/chunk-{{chunk:03d}}/{paths[version]}.parquet",
        "features": features,
    }
    (root / "meta").mkdir(parents=True)
    (root / "meta" / "info.json").write_text(json.dumps(info))
    tables = []
    for k, episode in enumerate(episodes):
        count = len(episode["time"])
        tables.append(
            pyarrow.table(
                {
                    "observation.state": list(episode["state"].astype(kind)),
                    "action": list(episode["action"].astype(kind)),
                    "timestamp": pyarrow.array(episode["time"].astype(kind)),
                    "frame_index": np.arange(count),
                    "episode_index": np.full(count, k),
                    "index": np.arange(count) + sum(len(e["time"]) for e in episodes[:k]),
                    "task_index": np.zeros(count, int),
                }
            )
        )
    folder = root / "data" / "chunk-000"
    folder.mkdir(parents=True)
    if version == "v2.1":
        for k, table in enumerate(tables):
            parquet.write_table(table, folder / f"episode_{k:06d}.parquet")
    else:
        parquet.write_table(pyarrow.concat_tables(tables), folder / "file-000.parquet")
    return root
