"""Settings: every default runs, and what is wrong is named."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from facet.commands.configuration import toml_of
from facet.config import (
    Config,
    ConfigError,
    Section,
    is_loopback,
    load_config,
    load_credentials,
)


def load(tmp_path: Path, text: str) -> object:
    path = tmp_path / "facet.toml"
    path.write_text(text)
    return load_config(path)


def test_it_runs_without_a_file() -> None:
    config = load_config()
    assert config.network.listen == ("tcp/127.0.0.1:7447",)
    assert config.mapping.given() == {}


def test_options_come_over_the_file(tmp_path: Path) -> None:
    path = tmp_path / "facet.toml"
    path.write_text('[map]\nid = "hall"\n[mapping]\nvoxel_m = 0.1\n')
    config = load_config(path, {"mapping.voxel_m": 0.2, "map.id": None})
    assert (config.map.id, config.mapping.given()) == ("hall", {"voxel_m": 0.2})


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[mapping]\nvoxel = 0.1", r"unknown key mapping\.voxel; did you mean mapping\.voxel_m\?"),
        ("[maping]\nvoxel_m = 0.1", r"unknown key maping; did you mean mapping\?"),
        ("[mapping]\nvoxel_m = 7", r"mapping\.voxel_m = 7: .*>= 0\.005 and <= 1\.0"),
        ('[map]\nid = "a/b"', r"map\.id = 'a/b'"),
        ('viewer = "wbe"', "viewer: must be off, web, native"),
        ('[record]\ncompression = "gz"', "record.compression = 'gz'"),
        ("x = [", "facet.toml"),
        ("map = 3", r"map = 3: should be a table, that is a line \[map\]"),
        ("[mapping]\nvoxel_m = 5", r"voxel_m = 5: allowed is >= 0.005 and <= 1.0 m$"),
        ('[network]\nlisten = ["127.0.0.1:7447"]', "'127.0.0.1:7447' is no endpoint: .*tcp/"),
        ('[network]\nconnect = ["tcp/localhost"]', "'tcp/localhost' is no endpoint"),
        ('[network]\nlisten = ["tcp/127.0.0.1:77777"]', "is no endpoint"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        load(tmp_path, text)


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"nowhere\.toml"):
        load_config(tmp_path / "nowhere.toml")


def test_everything_that_can_be_set_is_printed_and_read_back(tmp_path: Path) -> None:
    """`facet config`: what it prints is a file that says the same."""
    text = "\n".join(toml_of(load_config()))
    assert load(tmp_path, text) == load_config()
    for name, section in Config():
        for key in type(section).model_fields if isinstance(section, Section) else (name,):
            assert re.search(rf"^(# )?{key} =", text, re.MULTILINE), key
    assert re.search(r"^# voxel_m = 0\.05 .*>= 0\.005 and <= 1\.0 m$", text, re.MULTILINE)


def test_rules_are_printed_as_the_tables_they_are(tmp_path: Path) -> None:
    rules = "".join(f'[[robots.rules]]\nkey = "{k}/**"\nframe = \'a "b\'\n' for k in "xy")
    config = load(tmp_path, f"{rules}[record]\nresume = false")
    assert isinstance(config, Config)
    assert len(config.robots.rules) == 2
    assert load(tmp_path, "\n".join(toml_of(config))) == config


@pytest.mark.parametrize(
    ("endpoint", "expected"),
    [
        ("tcp/127.0.0.1:7447", True),
        ("tcp/127.1.2.3:1", True),
        ("tcp/localhost:7447", True),
        ("tcp/[::1]:7447", True),
        ("unixsock-stream//tmp/facet", True),
        ("tcp/0.0.0.0:7447", False),
        ("tcp/[::]:7447", False),
        ("tcp/192.168.1.4:7447", False),
        ("tcp/127.0.0.1.robots.example:7447", False),
        ("tcp/127:7447", False),
        ("tls/robots.example:7447", False),
    ],
)
def test_loopback(endpoint: str, expected: bool) -> None:
    assert is_loopback(endpoint) is expected


OPEN = 'listen = ["tls/0.0.0.0:7447"]\n'
KEYS = 'listen_certificate = "c.pem"\nlisten_private_key = "k.pem"\n'


@pytest.mark.parametrize(
    ("network", "accepted"),
    [
        ('listen = ["tcp/0.0.0.0:7447"]\nusers_file = "u"', False),
        (OPEN, False),
        (OPEN + KEYS, False),
        (OPEN + KEYS + 'mutual_tls = true\nroot_ca_certificate = "ca.pem"', True),
        (OPEN + KEYS + 'users_file = "u"', True),
    ],
)
def test_the_network_is_let_in_by_key_and_name_only(
    tmp_path: Path, network: str, accepted: bool
) -> None:
    text = f"[network]\n{network}"
    if accepted:
        load(tmp_path, text)
    else:
        with pytest.raises(ConfigError, match="open to the network"):
            load(tmp_path, text)


@pytest.mark.parametrize(
    ("network", "said"),
    [
        (OPEN + 'listen_certificate = "c.pem"', "belong together"),
        (OPEN + KEYS + "mutual_tls = true", "needs root_ca_certificate"),
        ('connect = ["tcp/10.0.0.9:7447"]', "in the clear"),
    ],
)
def test_half_a_guard_is_none(tmp_path: Path, network: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        load(tmp_path, f"[network]\n{network}")


def test_a_password_is_in_no_message(tmp_path: Path) -> None:
    path = tmp_path / "robot.toml"
    path.write_text('user = "r1"\npassword = "hush"\ncertificate = "r1.pem"')
    told = load_credentials(path)
    assert told.password is not None
    assert told.password.get_secret_value() == "hush"
    assert "hush" not in repr(told)
    assert told.certificate == tmp_path / "r1.pem"  # beside the file
    path.write_text("password = 12345")
    with pytest.raises(ConfigError, match=r"password = \*\*\*") as error:
        load_credentials(path)
    assert "12345" not in str(error.value)


def test_a_section_that_is_no_table_is_named(tmp_path: Path) -> None:
    path = tmp_path / "facet.toml"
    path.write_text("map = 3")
    with pytest.raises(ConfigError, match="map = 3: should be a table"):
        load_config(path, {"map.id": "hall"})


def test_an_error_names_the_file_that_has_it(tmp_path: Path) -> None:
    """What is put on top of it may be the cure, and may be the error."""
    bad, good = tmp_path / "bad.toml", tmp_path / "good.toml"
    bad.write_text("[mapping]\ntheta_deg = 99\n")
    good.write_text("[mapping]\ntheta_deg = 12\n")
    with pytest.raises(ConfigError, match=r"bad\.toml: mapping\.theta_deg"):
        load_config(bad)
    assert load_config(bad, {"mapping.theta_deg": 12.0}).mapping.theta_deg == 12.0
    with pytest.raises(ConfigError, match=r"^mapping\.theta_deg"):
        load_config(good, {"mapping.theta_deg": 99.0})
