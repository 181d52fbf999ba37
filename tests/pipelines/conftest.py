import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))  # toy.py, also for the processes the tests start
sys.path.insert(0, str(Path(__file__).parents[1] / "train"))  # training_cases.py
