"""``replay://`` addresses: a vehicle that replays a recording."""
