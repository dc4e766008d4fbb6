"""`mrcdrl train`: starts a run's services on this machine, watches them and ends them."""
