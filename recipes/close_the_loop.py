"""Finds the effects that a simulator lacks from measured data: the console command ``close-the-loop`` as a script.

python recipes/close_the_loop.py                                           # the wheel-legged robot, nothing downloaded
python recipes/close_the_loop.py data=standing_still.txt                   # the same with the real robot's log
python recipes/close_the_loop.py simulator=HalfCheetah-v5 simulator.gap=gravity data=halfcheetah/medium-replay-v0
python recipes/close_the_loop.py simulator=robot.xml data=log.csv columns=log.yaml       # your own model and log
"""

from torchrl_h2o.commands.close_the_loop import run

if __name__ == "__main__":
    run()
