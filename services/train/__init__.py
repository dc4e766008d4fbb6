"""`mrcdrl train`: starts a run's services on this machine, shows it, records it, ends it."""
