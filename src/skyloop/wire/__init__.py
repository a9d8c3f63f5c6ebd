"""The bytes that vehicles and motion capture systems speak, both ways and pure: what a driver and an emulator share."""
