"""Effects on actions: how the executed action differs from the commanded one."""
