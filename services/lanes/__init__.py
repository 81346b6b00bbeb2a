"""How messages cross from host to host: reduced for thin links, shared out between decoders, back in order."""
