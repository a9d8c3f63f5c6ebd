"""``replay://FLIGHT.mcap``: a vehicle that replays a recording."""
