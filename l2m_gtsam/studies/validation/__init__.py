"""What validation says of drives after which the place changed, the vehicle, both or nothing."""
