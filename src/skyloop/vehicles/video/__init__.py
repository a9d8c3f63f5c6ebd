"""``video://PATH``: a vehicle whose camera is a recorded file or a video device."""

from skyloop.vehicles.video.driver import VideoDriver

__all__ = ["VideoDriver"]
