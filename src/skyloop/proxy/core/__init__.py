"""The proxy's decisions, pure: inputs and the time are arguments, there is no thread, socket, lock or clock in here."""
