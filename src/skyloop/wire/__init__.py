"""The bytes that real vehicles speak, both ways and pure: what a driver and an emulated vehicle have in common."""
