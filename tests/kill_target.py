"""A service to be killed: it says on its standard output what it has acknowledged, and no more. Of
junk it says nothing: who listens would be busy with that."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path
from typing import Any

from facet.config import Config, load_config
from facet.mapping.mapper import Mapper
from facet.mapping.settings import MapSettings
from facet.resume import resume
from facet.service import Service
from facet.session import open_session, service_settings
from facet.warmup import warm_up
from facet_protocol.messages import Envelope

SETTINGS = MapSettings(voxel_m=0.1)


def config_of(
    folder: Path, endpoint: str = "tcp/127.0.0.1:7447", checkpoint_s: float = 0.4
) -> Config:
    """Often a checkpoint, so that some are killed in the middle of one."""
    overrides = {
        "network.listen": [endpoint],
        "network.shared_memory": False,
        "record.directory": folder,
        "record.min_free_bytes": 0,
        "record.checkpoint_s": checkpoint_s,
        "record.max_file_bytes": 2 << 20,
        "mapping.voxel_m": SETTINGS.voxel_m,
        "publish.points": False,
    }
    return load_config(None, overrides)


def main(folder: Path, endpoint: str, checkpoint_s: float, is_warm: bool) -> None:
    config = config_of(folder, endpoint, checkpoint_s)
    if is_warm:  # as `facet run` is
        warm_up(SETTINGS)
    resumed = resume(config, Mapper(SETTINGS))
    with open_session(service_settings(config.network)) as session:
        service = Service(session, config, resumed.mapper, resumed)
        put = service._durable.put

        def tell(envelopes: list[Envelope], end: Any = None) -> None:
            heard = (e for e in envelopes if "/robot/junk/" not in e.key)
            lines = [f"{e.key} {e.epoch} {e.sequence}\n" for e in heard]
            os.write(1, "".join(lines).encode())
            put(envelopes, end)

        service._durable.put = tell  # type: ignore[method-assign]
        service.start()
        os.write(1, b"ready\n")
        signal.pause()


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], float(sys.argv[3]), sys.argv[4] == "warm")
