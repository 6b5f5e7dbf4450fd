"""Effects on observations: how the reported observation differs from the true one."""
