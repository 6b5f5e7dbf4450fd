"""Tutorial: what to record next. A payload, or a weak motor? Takes one to two minutes.

python recipes/tutorials/what_to_record_next.py [folder]     # writes commands.csv and experiment.html there

A two-link arm swings less far than its model. One slow log does not tell why. The tutorial designs the log that does.
"""

import torchrl_h2o.quiet  # noqa: F401, I001  (must precede the packages that it silences)

import sys
from pathlib import Path

import numpy as np

from torchrl_h2o.effects import Payload
from torchrl_h2o.experiment import Envelope, as_ted, joined, next_experiment
from torchrl_h2o.residuals import Simulation, close_the_loop

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "outputs/tutorial_next")
folder.mkdir(parents=True, exist_ok=True)

# %% The model, as MJCF.
(folder / "arm.xml").write_text("""
<mujoco model="arm">
  <option timestep="0.002"/>
  <default><geom type="capsule" contype="0" conaffinity="0"/></default>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" axis="0 1 0" damping="0.05"/>
      <geom fromto="0 0 0 0 0 -0.3" size="0.03" mass="1"/>
      <body name="lower" pos="0 0 -0.3">
        <joint name="elbow" axis="0 1 0" damping="0.02"/>
        <geom fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.5"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="shoulder_motor" joint="shoulder" ctrlrange="-4 4"/>
    <motor name="elbow_motor" joint="elbow" ctrlrange="-1.5 1.5"/>
  </actuator>
</mujoco>
""")
observed = ["shoulder", "elbow", "shoulder_velocity", "elbow_velocity"]
simulator = Simulation.from_mjcf(folder / "arm.xml", observed, 0.01)

# %% The machine. Yours is real. Here it is simulated: its hand holds 0.15 kg, and its encoders have noise.
machine = simulator.with_effects(Payload(0.15, z=-0.3, bodies="lower"))
noise = np.array([2e-3, 2e-3, 2e-2, 2e-2])  # rad and rad/s


def run_on_the_machine(torques: np.ndarray, seed: int):
    states = np.vstack([np.zeros((1, 4)), machine.rollout(np.zeros((1, 4)), torques[None])[0]])
    return as_ted(states + noise * np.random.default_rng(seed).standard_normal(states.shape), torques)


# %% The first log: a slow swing of the shoulder. A weak motor explains it as well as a payload does.
times = 0.01 * np.arange(800)
slow = np.stack([0.5 * np.sin(2.0 * np.pi * 0.1 * times), np.zeros_like(times)], axis=1)
first = run_on_the_machine(slow, seed=0)

few = ("Payload", "ActionGain", "JointDamping", "JointFrictionLoss", "ActionDelay")
candidates = [entry for entry in simulator.catalogue() if type(entry.effect).__name__ in few]
report = close_the_loop(simulator, first, candidates)
print(f"\nthe first log: {report.sentence()}\n")

# %% The commands that tell apart what it leaves open, within 0.8 rad of the pose at rest.
experiment = next_experiment(simulator, first, report, Envelope(seconds=5.0, within=0.8), minutes=0.5)
experiment.save(folder)
print(f"\n{experiment.words()}\n\ncommands: {folder / 'commands.csv'}, look at {folder / 'experiment.html'}\n")

# %% The second log, and the loop closed on both. The new log comes first: errors are reported on the end of the data.
both = joined(run_on_the_machine(experiment.commands, seed=1), first)
print(f"\nboth logs: {close_the_loop(simulator, both, candidates).sentence()}")
