"""``video://PATH``: a vehicle whose camera is a recorded file or a video device."""
