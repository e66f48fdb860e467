"""Settings of the shell: typed, with every default here; a file (TOML) only says what differs."""

from __future__ import annotations

import difflib
import tomllib
from ipaddress import ip_address
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_args

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


class Section(BaseModel):
    """A table of the file: unknown keys are refused, values are fixed once loaded."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class MapSection(Section):
    """Names: the map's own, and that of the frame its poses are given in."""

    id: Id = "map"
    frame: str = "map"


class MappingSection(Section):
    """What the method is told; None leaves the mapper's own default."""

    voxel_m: float | None = Field(default=None, ge=0.005, le=1.0)  # m: resolution
    theta_deg: float | None = Field(default=None, ge=1.0, le=45.0)  # thicker: no normal
    detail_level: float | None = Field(default=None, ge=0.5, le=1.0)  # share of voxels on planes
    reach_m: float | None = Field(default=None, ge=0.1, le=1000.0)  # m: reach of empty beams
    min_range_m: float | None = Field(default=None, ge=0.0, le=1000.0)  # m
    max_range_m: float | None = Field(default=None, gt=0.0, le=10000.0)  # m

    def given(self) -> dict[str, float]:
        """The values that were set, by name."""
        return self.model_dump(exclude_none=True)


class NetworkSection(Section):
    """The Zenoh session: where it listens and connects, what it lets in."""

    listen: tuple[str, ...] = ("tcp/127.0.0.1:7447",)
    connect: tuple[str, ...] = ()
    max_message_bytes: int = Field(default=16 * MIB, ge=1024, le=48 * MIB)  # a chunk: 64 MiB
    max_sessions: int = Field(default=256, ge=1, le=10_000)  # peers at once; the next is refused
    shared_memory: bool = True
    root_ca_certificate: Path | None = None
    listen_certificate: Path | None = None
    listen_private_key: Path | None = None
    mutual_tls: bool = False
    users_file: Path | None = None  # lines "user:password"
    access_control: Path | None = None  # JSON5: Zenoh's table of that name (docker/secure)

    credentials: Path | None = None  # TOML: what we show to the routers of `connect`

    @model_validator(mode="after")
    def _closed_to_strangers(self) -> NetworkSection:
        if (self.listen_certificate is None) != (self.listen_private_key is None):
            raise ValueError("listen_certificate and listen_private_key belong together")
        if self.mutual_tls and self.root_ca_certificate is None:
            raise ValueError("mutual_tls needs root_ca_certificate: who signed the robots' own")
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

    max_ram_mb: int | None = Field(default=None, ge=512)  # MiB, of the whole process


class QueueSection(Section):
    """How much may wait between the network and the log. Half full, the network waits for a while;
    full, the oldest is shed, and counted."""

    max_messages: int = Field(default=8192, ge=1, le=1_000_000)
    max_bytes: int = Field(default=256 * MIB, ge=MIB, le=65536 * MIB)
    patience_s: float = Field(default=2.0, ge=0.0, le=4.0)  # Zenoh cuts a link that waits for 5


class RecordSection(Section):
    """The log: what is not in it is not in the map."""

    directory: Path = Path("out/log")
    # durable: what is acknowledged survives a power cut; fast: the end of this process only
    mode: Literal["durable", "fast"] = "durable"
    commit_ms: int = Field(default=50, ge=1, le=1000)
    compression: Literal["lz4", "zstd", "none"] = "lz4"
    max_file_bytes: int = Field(default=1024 * MIB, ge=MIB)
    max_file_s: int = Field(default=3600, ge=1)
    # bytes left to others; None: 1 GiB, or 2 % of the disk if that is more
    min_free_bytes: int | None = Field(default=None, ge=0)
    retry_s: float = Field(default=5.0, gt=0.0, le=600.0)
    on_full: Literal["retry", "exit"] = "retry"
    resume: bool = True  # go on with the map whose log lies in the directory
    checkpoint_s: float = Field(default=60.0, ge=0.0)  # 0: only at the end, and when asked


class RuleSection(Section):
    """What messages of some keys are, or whose, where they do not say it themselves."""

    key: Annotated[str, Field(pattern=r"^/?[^/]+(/[^/]+)*$")]  # key expression, or a topic of ROS
    type: str = ""  # schema: sensor_msgs/msg/PointCloud2, foxglove.PointCloud, ...
    robot: Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{0,64}$")] = ""
    sensor: Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{0,64}$")] = ""
    frame: str = ""  # of a scan: the frame of its points; of a pose: the frame it is the pose of
    envelope_field: int = Field(default=0, ge=0, le=536_870_911)  # the field that holds the message


class RobotsSection(Section):
    """Robots that do not speak Facet's own keys: which keys are listened to, and what they mean."""

    keys: tuple[str, ...] = ("**",)  # key expressions; () leaves Facet's own alone
    rules: tuple[RuleSection, ...] = ()  # the first that fits counts
    wait_s: float = Field(default=0.5, gt=0.0, le=60.0)  # of stamps: for a pose, and between two
    wait_bytes: int = Field(default=256 * MIB, ge=MIB, le=65536 * MIB)  # of scans that wait
    reject_jumps: bool = False  # a pose 5 m or 90 degrees off at once: refused, not only flagged
    strict: bool = False  # a second publisher under one name: refused, not only an alarm


class PublishSection(Section):
    """What leaves over Zenoh."""

    status_s: float = Field(default=1.0, gt=0.0, le=60.0)
    points: bool = True
    points_s: float = Field(default=0.5, gt=0.0, le=60.0)  # changed tiles, at most this often
    queue: int = Field(default=64, ge=1, le=4096)  # updates; the oldest goes


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
    viewer: str = "off"  # off | web | native | connect:URL

    @field_validator("viewer")
    @classmethod
    def _known_viewer(cls, viewer: str) -> str:
        if viewer in ("off", "web", "native") or viewer.startswith("connect:"):
            return viewer
        raise ValueError("must be off, web, native or connect:URL")


def load_config(path: Path | None = None, overrides: dict[str, Any] | None = None) -> Config:
    """The settings of a file, with `{"section.key": value}` on top; None values override nothing.

    Raises ConfigError, also for a file that is not there or not TOML.
    """
    tree = _read_toml(path) if path is not None else {}
    for dotted, value in (overrides or {}).items():
        if value is not None:
            _put(tree, dotted.split("."), value)
    return _validate(Config, tree)


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
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
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
    text = error["msg"][:1].lower() + error["msg"][1:]
    value = "***" if where == "password" else f"{error['input']!r:.200}"
    return f"{where} = {value}: {text}{_range(model, error['loc'])}"


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


def _range(model: type[BaseModel], loc: tuple[Any, ...]) -> str:
    field = _section(model, loc).model_fields.get(str(loc[-1]))
    signs = {"ge": ">=", "gt": ">", "le": "<=", "lt": "<"}
    limits = [
        f"{sign} {getattr(constraint, name)}"
        for constraint in (field.metadata if field else [])
        for name, sign in signs.items()
        if hasattr(constraint, name)
    ]
    return f" (allowed: {' and '.join(limits)})" if limits else ""
