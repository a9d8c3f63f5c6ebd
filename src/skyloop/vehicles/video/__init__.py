"""``video://PATH``: a vehicle whose camera is a video file or a video device."""
