"""The truth: seabed, vehicles and multibeam sonar. Nothing under firmware may import it."""
