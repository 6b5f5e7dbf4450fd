"""Effects on the MuJoCo model: masses, geometry, joints, contacts, gravity, timestep."""
