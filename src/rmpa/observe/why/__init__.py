"""Why a topic or a service of a peer does not arrive: the stages of its path, judged by what both agents know."""
