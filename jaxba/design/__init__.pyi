from ._flight_plan import FlightPlan as FlightPlan, example as example, read_plan as read_plan, sections as sections
from ._flown import network_of_block as network_of_block
from ._forecast import forecast as forecast, gains as gains, improved as improved
from ._modes import Mode as Mode, dome_std_m as dome_std_m, shift_std_m as shift_std_m, weakest_modes as weakest_modes
from ._network import Network as Network, Spots as Spots, spots_in as spots_in
from ._place import Place as Place
from ._placement import MOST_POINTS as MOST_POINTS, Placed as Placed, place_control as place_control
from ._planned import network_of as network_of
from ._sections import Control as Control
from ._stations import Stations as Stations, stations_of as stations_of
from ._variants import with_control as with_control
