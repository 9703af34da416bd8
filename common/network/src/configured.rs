//! Network parameters from pipeline.yaml.

use flockeye_config::{GatewayMode, Pipeline, Security};
use flockeye_identity::MemberFiles;

use crate::parameters::{NetworkMode, NetworkParameters};

impl NetworkParameters {
    /// Parameters of the gateway's session.
    pub fn of_drone(pipeline: &Pipeline) -> Self {
        Self {
            swarm: pipeline.observer.swarm.clone(),
            observer: pipeline.observer.name.clone(),
            mode: match pipeline.gateway.mode {
                GatewayMode::Peer => NetworkMode::Peer,
                GatewayMode::Client => NetworkMode::Client,
            },
            listen: pipeline.gateway.listen.clone(),
            connect: pipeline.gateway.connect.clone(),
            security: pipeline.gateway.security.as_ref().map(member_files),
            scout_interface: pipeline.gateway.scout_interface.clone(),
            ..Self::default()
        }
    }

    /// Parameters of an onlooker, which is no drone of the swarm. It connects to this machine's own
    /// gateway, and to the gateway's own endpoints.
    pub fn of_onlooker(pipeline: &Pipeline) -> Self {
        let gateway = &pipeline.gateway;
        let listen: &[String] =
            if gateway.mode == GatewayMode::Client { &[] } else { &gateway.listen };
        let own = listen.iter().chain(&gateway.connect);
        Self {
            mode: NetworkMode::Peer,
            // Port 0 stands for any port, so there is nothing to connect to.
            connect: own.filter(|endpoint| !endpoint.ends_with(":0")).cloned().collect(),
            listen: Vec::new(),
            is_onlooker: true,
            ..Self::of_drone(pipeline)
        }
    }
}

fn member_files(security: &Security) -> MemberFiles {
    let Security { ca, certificate, key, roster } = security.clone();
    MemberFiles { ca, certificate, key, roster }
}
