"""The MuJoCo simulation inside a TorchRL env, for Gymnasium and for dm_control."""
