"""Scenes with exact truth, and the scans that simulated sensors take of them."""

from facet.simulate.scenes import SCENES, Scene
from facet.simulate.sensors import SENSORS, Sensor
from facet.simulate.simulation import Noise, Simulation, simulate
from facet.simulate.truth import Observer, Truth, scene_truth

__all__ = [
    "SCENES",
    "SENSORS",
    "Noise",
    "Observer",
    "Scene",
    "Sensor",
    "Simulation",
    "Truth",
    "scene_truth",
    "simulate",
]
