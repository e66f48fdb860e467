"""Settings of the shell: typed, with every default here; a file (TOML) only says what differs."""

from __future__ import annotations

import difflib
import re
import tomllib
from copy import deepcopy
from ipaddress import ip_address
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    SecretStr,
    ValidationError,
    field_validator,
    model_validator,
)

MIB = 1 << 20
ENCRYPTED = ("tls/", "quic/")
UNITS = {"m": "m", "deg": "degrees", "s": "s", "ms": "ms", "mb": "MiB", "bytes": "bytes"}
OUT_OF_RANGE = ("greater_than", "greater_than_equal", "less_than", "less_than_equal")
_PORT = re.compile(r".+:([0-9]{1,5})([?#].*)?")
Id = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,64}$")]


S = TypeVar("S", bound="Section")


class ConfigError(ValueError):
    """A setting that cannot be used; the message names the key, the value and what is allowed."""


def is_loopback(endpoint: str) -> bool:
    """Whether a Zenoh endpoint (`tcp/127.0.0.1:7447`) is reachable from this machine only."""
    protocol, _, address = endpoint.partition("/")
    if protocol.startswith("unix"):
        return True
    host = address.split("?")[0].split("#")[0].rpartition(":")[0].strip("[]")
    try:
        return host == "localhost" or ip_address(host).is_loopback
    except ValueError:  # a name, and names can mean anything
        return False


def is_endpoint(text: str) -> bool:
    """Whether it has the form of a Zenoh endpoint: PROTOCOL/ADDRESS, with a port where one is."""
    protocol, _, address = text.partition("/")
    if protocol.startswith("unix"):
        return bool(address)
    port = _PORT.fullmatch(address)
    return bool(protocol) and port is not None and int(port[1]) < 1 << 16


class Section(BaseModel):
    """A table of the file: unknown keys are refused, values are fixed once loaded."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class MapSection(Section):
    """Names: the map's own, and that of the frame its poses are given in."""

    id: Id = Field(default="map", description="the map's name, a part of every key")
    frame: str = Field(default="map", description="the frame that poses lead to")


class MappingSection(Section):
    """What the method is told; None leaves the mapper's own default."""

    voxel_m: float | None = Field(default=None, ge=0.005, le=1.0, description="the resolution")
    theta_deg: float | None = Field(
        default=None, ge=1.0, le=45.0, description="thickness angle; thicker: no normal"
    )
    detail_level: float | None = Field(
        default=None, ge=0.5, le=1.0, description="share of the voxels that planes must hold"
    )
    reach_m: float | None = Field(
        default=None, ge=0.1, le=1000.0, description="how far a beam that comes back empty counts"
    )
    min_range_m: float | None = Field(
        default=None, ge=0.0, le=1000.0, description="what is nearer is no point"
    )
    max_range_m: float | None = Field(
        default=None, gt=0.0, le=10000.0, description="what is farther is no point"
    )

    def given(self) -> dict[str, float]:
        """The values that were set, by name."""
        return self.model_dump(exclude_none=True)


class NetworkSection(Section):
    """The Zenoh session: where it listens and connects, what it lets in."""

    listen: tuple[str, ...] = Field(
        default=("tcp/127.0.0.1:7447",), description="beyond loopback: tls/ with certificates only"
    )
    connect: tuple[str, ...] = Field(default=(), description="other routers to join")
    # the upper limit: a chunk of the log holds 64 MiB
    max_message_bytes: int = Field(
        default=16 * MIB, ge=1024, le=48 * MIB, description="the largest message let in"
    )
    max_sessions: int = Field(
        default=256, ge=1, le=10_000, description="peers at once; the next is refused"
    )
    shared_memory: bool = Field(default=True, description="for peers on this machine")
    root_ca_certificate: Path | None = Field(default=None, description="who signed certificates")
    listen_certificate: Path | None = Field(default=None, description="our own, for tls/")
    listen_private_key: Path | None = Field(default=None, description="belongs to it")
    mutual_tls: bool = Field(default=False, description="robots show a certificate too")
    users_file: Path | None = Field(default=None, description="lines user:password")
    access_control: Path | None = Field(
        default=None, description="JSON5: Zenoh's table of that name, as in docker/secure"
    )
    credentials: Path | None = Field(
        default=None, description="TOML: what we show to the routers of connect"
    )

    @model_validator(mode="after")
    def _closed_to_strangers(self) -> NetworkSection:
        if (self.listen_certificate is None) != (self.listen_private_key is None):
            raise ValueError("listen_certificate and listen_private_key belong together")
        if self.mutual_tls and self.root_ca_certificate is None:
            raise ValueError("mutual_tls needs root_ca_certificate: who signed the robots' own")
        for endpoint in (*self.listen, *self.connect):
            if not is_endpoint(endpoint):
                raise ValueError(
                    f"{endpoint!r} is no endpoint: that is PROTOCOL/HOST:PORT, "
                    "as in tcp/127.0.0.1:7447"
                )
        for endpoint in self.listen:
            if not is_loopback(endpoint) and not self._is_guarded(endpoint):
                raise ValueError(
                    f"{endpoint} is open to the network: anyone could put points into the map. "
                    "Listen on 127.0.0.1, or use tls/ or quic/ with listen_certificate, "
                    "listen_private_key and either mutual_tls or users_file"
                )
        for endpoint in self.connect:
            if not is_loopback(endpoint) and not endpoint.startswith(ENCRYPTED):
                raise ValueError(f"{endpoint} leaves this machine in the clear: use tls/ or quic/")
        return self

    def _is_guarded(self, endpoint: str) -> bool:
        has_keys = self.listen_certificate is not None
        known = self.mutual_tls or self.users_file is not None
        return endpoint.startswith(ENCRYPTED) and has_keys and known


class Credentials(Section):
    """What a client shows at a guarded door: a file of its own, readable by its owner alone."""

    user: str | None = None
    password: SecretStr | None = None
    root_ca_certificate: Path | None = None
    certificate: Path | None = None
    private_key: Path | None = None


class MemorySection(Section):
    """How much memory the service may hold. The map's columns then lie in files of the log's
    folder, and their cold pages go to the disk; None: all in memory."""

    max_ram_mb: int | None = Field(
        default=None, ge=512, description="of the whole process; the rest lies in files by the log"
    )


class QueueSection(Section):
    """How much may wait between the network and the log. Half full, the network waits for a while;
    full, the oldest is shed, and counted."""

    max_messages: int = Field(
        default=8192, ge=1, le=1_000_000, description="may wait for the log; full, the oldest goes"
    )
    max_bytes: int = Field(
        default=256 * MIB, ge=MIB, le=65536 * MIB, description="the same, in bytes"
    )
    # Zenoh cuts a link that waits for 5 s
    patience_s: float = Field(
        default=2.0, ge=0.0, le=4.0, description="the network waits so long when it is half full"
    )


class RecordSection(Section):
    """The log: what is not in it is not in the map."""

    directory: Path = Field(default=Path("out/log"), description="folder of the log")
    mode: Literal["durable", "fast"] = Field(
        default="durable", description="fast: survives the end of the process, but no power cut"
    )
    commit_ms: int = Field(default=50, ge=1, le=1000, description="how often the disk is told")
    compression: Literal["lz4", "zstd", "none"] = "lz4"
    max_file_bytes: int = Field(default=1024 * MIB, ge=MIB, description="then a new file begins")
    max_file_s: int = Field(default=3600, ge=1, description="the same, by age")
    min_free_bytes: int | None = Field(
        default=None, ge=0, description="left to others; else 1 GiB, or 2 % of the disk if more"
    )
    retry_s: float = Field(
        default=5.0, gt=0.0, le=600.0, description="between attempts when the disk fails"
    )
    on_full: Literal["retry", "exit"] = Field(
        default="retry", description="when the disk fails; exit: with 74"
    )
    resume: bool = Field(default=True, description="go on with the map whose log lies there")
    checkpoint_s: float = Field(
        default=60.0, ge=0.0, description="between checkpoints; 0: at the end and when asked"
    )


class RuleSection(Section):
    """What messages of some keys are, or whose, where they do not say it themselves."""

    key: str = Field(pattern=r"^/?[^/]+(/[^/]+)*$", description="key expression, or a topic of ROS")
    type: str = Field(default="", description="schema, as sensor_msgs/msg/PointCloud2")
    robot: str = Field(default="", pattern=r"^[A-Za-z0-9_-]{0,64}$", description="its name")
    sensor: str = Field(default="", pattern=r"^[A-Za-z0-9_-]{0,64}$", description="its name")
    frame: str = Field(
        default="", description="of a scan: that of its points; of a pose: what it is the pose of"
    )
    envelope_field: int = Field(
        default=0, ge=0, le=536_870_911, description="of protobuf: which one holds the message"
    )


class RobotsSection(Section):
    """Robots that do not speak Facet's own keys: which keys are listened to, and what they mean."""

    keys: tuple[str, ...] = Field(
        default=("**",), description="key expressions listened to; [] leaves Facet's own alone"
    )
    rules: tuple[RuleSection, ...] = Field(
        default=(), description="tables [[robots.rules]]; the first that fits counts"
    )
    wait_s: float = Field(
        default=0.5, gt=0.0, le=60.0, description="of stamps: for a pose, and between two"
    )
    wait_bytes: int = Field(
        default=256 * MIB, ge=MIB, le=65536 * MIB, description="of scans that wait for a pose"
    )
    reject_jumps: bool = Field(
        default=False, description="a pose 5 m or 90 degrees off: refused, not only flagged"
    )
    strict: bool = Field(
        default=False, description="a second publisher under one name: refused, no mere alarm"
    )


class PublishSection(Section):
    """What leaves over Zenoh."""

    status_s: float = Field(default=1.0, gt=0.0, le=60.0, description="between two words of it")
    points: bool = Field(default=True, description="whether points are published too")
    points_s: float = Field(
        default=1.0, gt=0.0, le=60.0, description="changed points, at most this often"
    )
    queue: int = Field(
        default=64, ge=1, le=4096, description="updates that may wait; full, the oldest goes"
    )


class Config(Section):
    """Everything `facet run` can be told."""

    map: MapSection = MapSection()
    mapping: MappingSection = MappingSection()
    network: NetworkSection = NetworkSection()
    robots: RobotsSection = RobotsSection()
    memory: MemorySection = MemorySection()
    queue: QueueSection = QueueSection()
    record: RecordSection = RecordSection()
    publish: PublishSection = PublishSection()
    viewer: str = Field(
        default="off", description="dashboard: off | web | native | connect:URL of a Rerun"
    )

    @field_validator("viewer")
    @classmethod
    def _known_viewer(cls, viewer: str) -> str:
        if viewer in ("off", "web", "native") or viewer.startswith("connect:"):
            return viewer
        raise ValueError(f"must be off, web, native or connect:URL, is {viewer!r}")


def load_config(path: Path | None = None, overrides: dict[str, Any] | None = None) -> Config:
    """The settings of a file, with `{"section.key": value}` on top; None values override nothing.

    Raises ConfigError, also for a file that is not there or not TOML.
    """
    told = _read_toml(path) if path is not None else {}
    tree = deepcopy(told)
    for dotted, value in (overrides or {}).items():
        if value is not None:
            _put(tree, dotted.split("."), value)
    try:
        return _validate(Config, tree)
    except ConfigError as error:
        if path is None or _is_valid(told):
            raise
        raise ConfigError(f"{path}: {error}") from None


def _is_valid(tree: dict[str, Any]) -> bool:
    try:
        _validate(Config, tree)
    except ConfigError:
        return False
    return True


def load_credentials(path: Path) -> Credentials:
    """What a file of credentials says; paths in it are relative to it. Raises ConfigError."""
    told = _validate(Credentials, _read_toml(path))
    paths = {k: path.parent / v for k, v in told if isinstance(v, Path)}
    return told.model_copy(update=paths)


def _validate(model: type[S], tree: dict[str, Any]) -> S:
    try:
        return model.model_validate(tree)
    except ValidationError as error:
        raise ConfigError("; ".join(_explain(model, e) for e in error.errors())) from None


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: no text, byte {error.start} says: is it TOML?") from error
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path}: {error}") from error


def _put(tree: dict[str, Any], keys: list[str], value: Any) -> None:
    for key in keys[:-1]:
        tree = tree.setdefault(key, {})
        if not isinstance(tree, dict):
            raise ConfigError(f"{key} = {tree!r:.200}: should be a table")
    tree[keys[-1]] = value


def _explain(model: type[BaseModel], error: Any) -> str:
    """One line for one of pydantic's errors: key, value, and what would have been right."""
    where = ".".join(str(part) for part in error["loc"])
    if error["type"] == "extra_forbidden":
        return f"unknown key {where}{_nearest(model, error['loc'])}"
    if error["type"] == "value_error":
        return f"{where}: {error['ctx']['error']}" if where else str(error["ctx"]["error"])
    value = "***" if where == "password" else f"{error['input']!r:.200}"
    allowed = allowed_range(model, error["loc"])
    if error["type"] in OUT_OF_RANGE:
        return f"{where} = {value}: allowed is {allowed}"
    if error["type"] == "model_type":
        return f"{where} = {value}: should be a table, that is a line [{where}] and keys below it"
    text = error["msg"][:1].lower() + error["msg"][1:]
    return f"{where} = {value}: {text}" + (f" (allowed: {allowed})" if allowed else "")


def remarks(model: type[BaseModel], name: str) -> str:
    """What there is to say of a key: its meaning, its bounds, what it may be."""
    field = model.model_fields[name]
    choices = get_args(field.annotation) if get_origin(field.annotation) is Literal else ()
    parts = (field.description, " | ".join(choices), allowed_range(model, (name,)))
    return "; ".join(part for part in parts if part)


def _section(model: type[BaseModel], loc: tuple[Any, ...]) -> type[BaseModel]:
    for part in loc[:-1]:
        field = model.model_fields.get(str(part))
        annotation = field.annotation if field else None
        annotation = next(iter(get_args(annotation)), annotation)  # of a list: what is in it
        if isinstance(annotation, type) and issubclass(annotation, BaseModel):
            model = annotation
    return model


def _nearest(model: type[BaseModel], loc: tuple[Any, ...]) -> str:
    known = list(_section(model, loc).model_fields)
    near = difflib.get_close_matches(str(loc[-1]), known, n=1, cutoff=0.0)
    return f"; did you mean {'.'.join([*map(str, loc[:-1]), near[0]])}?" if near else ""


def allowed_range(model: type[BaseModel], loc: tuple[Any, ...]) -> str:
    """The bounds of a number, with their unit: `>= 0.005 and <= 1.0 m`; empty without bounds."""
    field = _section(model, loc).model_fields.get(str(loc[-1]))
    signs = {"ge": ">=", "gt": ">", "le": "<=", "lt": "<"}
    limits = [
        f"{sign} {getattr(constraint, name)}"
        for constraint in (field.metadata if field else [])
        for name, sign in signs.items()
        if hasattr(constraint, name)
    ]
    unit = UNITS.get(str(loc[-1]).rpartition("_")[2], "")
    return f"{' and '.join(limits)} {unit}".rstrip() if limits else ""
