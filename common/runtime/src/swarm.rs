//! The configured network.

use crate::config::Pipeline;
use crate::network::NetworkParameters;

impl Pipeline {
    /// How the gateway takes part in the swarm.
    pub fn network_parameters(&self) -> NetworkParameters {
        NetworkParameters {
            swarm: self.observer.swarm.clone(),
            observer: self.observer.name.clone(),
            listen: self.gateway.listen.clone(),
            connect: self.gateway.connect.clone(),
            scout_interface: self.gateway.scout_interface.clone(),
            ..NetworkParameters::default()
        }
    }

    /// How somebody looks on who is no drone of the swarm: through this machine's own gateway, and
    /// through whomever that connects to.
    pub fn onlooker_parameters(&self) -> NetworkParameters {
        let own = self.gateway.listen.iter().chain(&self.gateway.connect);
        NetworkParameters {
            // Port 0 is any port: there is nobody to find behind it.
            connect: own.filter(|endpoint| !endpoint.ends_with(":0")).cloned().collect(),
            listen: Vec::new(),
            ..self.network_parameters()
        }
    }
}
