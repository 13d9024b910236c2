"""Flies a figure eight in simulation: observer, NMPC and allocation at 100 Hz, from Python."""

import argparse
import sys

import numpy as np
import tilt_ropter as tr

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--vehicle", default="", help="vehicle file (JSON) with four rotors; "
                    "default: the Tilt-Ropter")
parser.add_argument("--seconds", type=float, default=15.0, help="duration; default: 15 s")
parser.add_argument("--wind", type=float, default=1.0, help="side force in the body [N]")
options = parser.parse_args()

vehicle = tr.Vehicle(options.vehicle)
allocation = tr.Allocation(vehicle)      # wrench -> rotor speeds, tilt angles
observer = tr.WrenchObserver(vehicle)    # external force and torque
nmpc = tr.Nmpc(vehicle)
plant = tr.Plant(vehicle)                # your robot goes here


def eight(time):
    """Any callable: time [s] to a point with its derivatives. Speeds up within about 2 s."""
    rest = np.exp(-time / 2.0)
    phase, speed, change = time - 2.0 * (1.0 - rest), 1.0 - rest, rest / 2.0
    size, times = np.array([1.5, 0.5, 0.3]), np.array([1.0, 2.0, 1.0])
    sine, cosine = np.sin(times * phase), np.cos(times * phase)
    return tr.Reference(position=size * sine + np.array([0.0, 0.0, 1.5]),
                        velocity=size * times * cosine * speed,
                        acceleration=size * times * (cosine * change - times * sine * speed**2))


# Hover at the start of the eight.
state = tr.State()
state.position = eight(0.0).position
weight = np.array([0.0, 0.0, vehicle.mass * tr.gravity, 0.0, 0.0, 0.0])
sent = allocation.allocate(weight)
plant.reset(state, sent.command)

disturbance = np.array([0.0, options.wind, 0.0, 0.0, 0.0, 0.0])
errors = []
for tick in range(int(100 * options.seconds)):
    time = plant.time
    applied = allocation.wrench(plant.actuators)
    observed = observer.update(time, plant.angular_velocity, plant.specific_force, applied)
    result = nmpc.step(time, plant.state, eight, observed)
    if not result.has_plan:
        sys.exit(f"no plan at {time:.2f} s: {result.status}")
    sent = allocation.allocate(time, result.wrench, result.rate, sent)
    for _ in range(10):
        plant.step(sent.command, 1e-3, disturbance)
    errors.append(np.linalg.norm(plant.state.position - eight(plant.time).position))

rmse = np.sqrt(np.mean(np.square(errors)))
print(f"rmse_m: {rmse:.4f}\nerror_max_m: {max(errors):.4f}")
print("external_force_n:", np.round(observed.external[:3], 2))
