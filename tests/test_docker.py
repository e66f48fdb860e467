"""What can be said about the containers without an engine: closed ports, settings that load."""

import re
from pathlib import Path

from facet.config import Config, is_loopback, load_config

DOCKER = Path(__file__).parents[1] / "docker"


def test_the_settings_load_and_stay_on_loopback():
    config = load_config(DOCKER / "service.toml")
    assert all(is_loopback(endpoint) for endpoint in config.network.listen)
    assert config.map.id == Config().map.id == "map"
    assert config.record.directory == Path("/data/log")


def test_ports_are_published_on_the_hosts_loopback_only():
    compose = (DOCKER / "compose.yaml").read_text()
    published = re.findall(r'- "([^"]*:\d+)"', compose)
    assert published == ["127.0.0.1:9090:9090", "127.0.0.1:9876:9876"]


def test_the_image_starts_the_dashboard_by_its_module():
    recipe = (DOCKER / "Dockerfile").read_text()
    module = re.search(r'"-m", "([a-z.]+)"', recipe)
    assert module is not None
    path = DOCKER.parent.joinpath("service", *module[1].split(".")).with_suffix(".py")
    assert path.exists()


def test_no_image_ends_as_root():
    users = re.findall(r"^USER (.+)$", (DOCKER / "Dockerfile").read_text(), re.MULTILINE)
    assert users[-1] == "10001:10001"
    assert users.count("0") == 1
