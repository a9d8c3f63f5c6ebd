"""``video://PATH``: a vehicle whose camera is a recorded file or a video device."""

from skyloop.drivers.video.driver import VideoDriver

__all__ = ["VideoDriver"]
