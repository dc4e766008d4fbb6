"""The actor: steps arenas by the newest weights and sends what happened to replay."""
