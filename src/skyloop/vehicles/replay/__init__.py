"""``replay://FLIGHT.mcap``: a vehicle that does again what was recorded."""
