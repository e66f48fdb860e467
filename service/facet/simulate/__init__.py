"""Scenes with exact truth, and the scans that simulated sensors take of them."""

from facet.simulate.scenes import SCENES, Scene
from facet.simulate.sensors import SENSORS, Sensor
from facet.simulate.simulation import Noise, Simulation, simulate

__all__ = ["SCENES", "SENSORS", "Noise", "Scene", "Sensor", "Simulation", "simulate"]
