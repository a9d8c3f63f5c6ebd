"""The Parrot AR.Drone 1 and 2: AT commands, navdata, configuration, video."""
