"""The router: relays between the processes of runs, so that replay need not listen itself."""
