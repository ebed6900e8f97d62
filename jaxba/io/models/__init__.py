"""Other programs' models, read and written: COLMAP in text and binary, OpenSfM; and what an audit takes of any form."""
