"""The actor: steps arenas with the newest weights and sends the transitions to replay."""
