"""Replays a trained policy: the console command ``h2o-evaluate`` as a script.

python recipes/evaluate.py checkpoint=outputs/wheel_legged/...                    # reality, with a film
python recipes/evaluate.py checkpoint=... in=simulator episodes=10 film=null
python recipes/evaluate.py checkpoint=... method="SAC in the simulator" film=frames   # a folder of PNG files
"""

from torchrl_h2o.commands.evaluate import run

if __name__ == "__main__":
    run()
