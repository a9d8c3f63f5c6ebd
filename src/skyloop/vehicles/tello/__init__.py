"""``tello://HOST``: the Ryze Tello, by its text protocol."""
