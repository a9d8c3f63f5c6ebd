"""``video://`` addresses: a vehicle whose camera is a video file, a device or a stream."""
