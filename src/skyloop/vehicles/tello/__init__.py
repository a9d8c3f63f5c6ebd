"""``tello://HOST``: the Ryze Tello and its text protocol."""
