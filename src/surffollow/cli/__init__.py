"""The `surffollow` command: one module per command, no logic."""
