"""Effects that show at rest: break-away forces, and departures from rest."""
