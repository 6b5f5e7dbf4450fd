"""Simulators with dynamics gaps in them: the TorchRL transform and the environments.

Needs MuJoCo, and Gymnasium or dm_control for their tasks (``pip install torchrl_h2o[envs]``).
"""
