"""Tutorial: what does my simulator lack? From a CSV log to a corrected simulator. Takes one to two minutes.

python recipes/tutorials/what_does_my_simulator_lack.py [folder]     # writes log.csv and report.html there

The MJCF model of a measured pendulum lacks an effect. The tutorial finds the effect with its value and interval.
"""

import torchrl_h2o.quiet  # noqa: F401, I001  (must precede the packages that it silences)

import sys
from pathlib import Path

import numpy as np

from torchrl_h2o.data import LogColumns, load
from torchrl_h2o.effects import JointDamping
from torchrl_h2o.residuals import Simulation, close_the_loop

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "outputs/tutorial")
folder.mkdir(parents=True, exist_ok=True)

# %% The model, as MJCF. It has little damping at the pivot.
(folder / "pendulum.xml").write_text("""
<mujoco model="pendulum">
  <option timestep="0.0025"/>
  <worldbody>
    <body name="arm">
      <joint name="pivot" axis="0 1 0" damping="0.02"/>
      <geom name="rod" type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="0.7"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="pivot"/></actuator>
</mujoco>
""")

# %% The log. Yours comes from your robot. Here random torques drive a simulated pendulum with more damping (0.1
# N·m·s/rad), sampled every 10 ms. Varying torques, and motions that cover the range of interest, make effects easier to
# distinguish.
observed = ["pivot", "pivot_velocity"]  # a joint's name means its position; the suffix _velocity means its velocity
robot = Simulation.from_mjcf(folder / "pendulum.xml", observed, 0.01, [JointDamping(0.1, joints="pivot")])
torque = np.repeat(np.random.default_rng(0).uniform(-2.0, 2.0, 80), 10)[:, None]
states = robot.rollout(np.zeros((1, 2)), torque[None])[0]
states = np.vstack([np.zeros((1, 2)), states[:-1]])  # each row has the state before its torque is applied
rows = np.hstack([states, torque])
np.savetxt(folder / "log.csv", rows, delimiter=",", header="pivot,pivot_velocity,torque", comments="")

# %% The description of the columns, in YAML. The names of the observations are coordinates of the model.
(folder / "log.yaml").write_text("""
dt: 0.01
separator: ","
header: true
columns:
  - {name: pivot, role: observation, unit: rad}
  - {name: pivot_velocity, role: observation, unit: rad/s}
  - {name: torque, role: action, unit: N·m}
""")
data = load(folder / "log.csv", columns=LogColumns.load(folder / "log.yaml"))

# %% The search. Every transition is simulated from its measured state. Effects from a catalogue are fitted to the
# difference between measurement and simulation, and kept only if they reduce the error on held-out rows. Here the
# catalogue is restricted to four effects; without the third argument of close_the_loop all effects are tried.
simulator = Simulation.from_mjcf(folder / "pendulum.xml", observed, 0.01)
few = ("JointDamping", "JointFrictionLoss", "Gravity", "ActionDelay")
candidates = [entry for entry in simulator.catalogue() if type(entry.effect).__name__ in few]
report = close_the_loop(simulator, data, candidates)

# %% The result: a sentence, and a report with values, intervals, the effects tried and those that cannot be
# distinguished.
print(report.sentence())
report.save(folder)
print(f"report: {folder / 'report.html'}")

# %% The corrected simulator. The effects found are of the same classes as those of dynamics gaps, so they can be added
# to the simulator directly. For training, use TransformedEnv(env, DynamicsGap(*report.effects)), or the option
# mend=report.json of recipes/h2o_plus.py.
corrected = simulator.with_effects(*report.effects)
for name, model in {"before": simulator, "after": corrected}.items():
    error = np.abs(model.rollout(states[:-1], torque[:-1, None])[:, 0] - states[1:]).max(0)
    print(f"largest one-step error {name}: {error[0]:.1e} rad, {error[1]:.1e} rad/s")
