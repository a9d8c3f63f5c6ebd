"""The Ryze Tello's text protocol: commands, replies, state, video.

From Ryze, "Tello SDK" 1.3 and "Tello SDK 2.0 User Guide".

What SDK 3.0 (Tello Talent, and EDU with newer firmware) has besides is known from the commands that djitellopy sends.
"""
