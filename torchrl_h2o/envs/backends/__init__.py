"""Access to the MuJoCo simulation inside a TorchRL env, for Gymnasium and dm_control tasks."""
