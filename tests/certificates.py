"""Certificates made for one test, and the example settings of docker/secure pointed at them."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

import trustme

SECURE = Path(__file__).parents[1] / "docker" / "secure"
USERS = {"r1": "one", "r2": "two", "desk": "three", "operator": "four"}


class Site:
    """A folder with what docker/secure asks for: a CA, the service's and the robots' keys."""

    def __init__(self, folder: Path, endpoint: str, local: str) -> None:
        self.folder, self.endpoint, self.local = folder, endpoint, local
        self._ca = trustme.CA()
        self._ca.cert_pem.write_to_path(str(folder / "ca.pem"))
        self.issue("service", "localhost", "127.0.0.1")
        for robot in ("r1", "r2", "desk"):
            self.issue(robot, f"{robot}.example")
        lines = [f"{user}:{password}" for user, password in USERS.items()]
        (folder / "users.txt").write_text("\n".join(lines) + "\n")

    def issue(self, name: str, *hosts: str, days: int = 30, ca: trustme.CA | None = None) -> None:
        """`name`.pem and `name`.key; `days` below 0: it has expired."""
        now = datetime.now(tz=UTC)
        issued = (ca or self._ca).issue_cert(
            *hosts,
            common_name=name,
            not_before=now - timedelta(days=90),
            not_after=now + timedelta(days=days),
        )
        issued.private_key_pem.write_to_path(str(self.folder / f"{name}.key"))
        chain = b"".join(blob.bytes() for blob in issued.cert_chain_pems)
        (self.folder / f"{name}.pem").write_bytes(chain)

    def settings(self, kind: str) -> Path:
        """The example service-`kind`.toml, on free ports of this machine, with these keys."""
        text = (SECURE / f"service-{kind}.toml").read_text()
        text = text.replace("tls/0.0.0.0:7448", self.endpoint)
        text = text.replace("tcp/127.0.0.1:7447", self.local)
        text = text.replace("/etc/facet/secure", str(self.folder))
        text = text.replace("/data/log", str(self.folder / "log"))
        access = f"access-{kind}.json5"
        (self.folder / access).write_text((SECURE / access).read_text())
        path = self.folder / f"service-{kind}.toml"
        path.write_text(text)
        return path

    def certificate_of(self, robot: str) -> Path:
        """The example robot-mtls.toml, for this robot."""
        text = (SECURE / "robot-mtls.toml").read_text().replace('"r1.', f'"{robot}.')
        path = self.folder / f"{robot}-mtls.toml"
        path.write_text(text)
        return path

    def login_of(self, user: str, password: str | None = None) -> Path:
        """The example robot-users.toml, for this user."""
        text = (SECURE / "robot-users.toml").read_text()
        text = text.replace('"r1"', f'"{user}"')
        text = text.replace("change-me", USERS[user] if password is None else password)
        path = self.folder / f"{user}-users.toml"
        path.write_text(text)
        return path
