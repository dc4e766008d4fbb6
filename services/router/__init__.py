"""The router: relays between the processes of runs where replay does not listen itself."""
