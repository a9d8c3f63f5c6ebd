"""``tello://`` addresses: the Ryze Tello and its text protocol."""
