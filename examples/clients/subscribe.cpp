// The smallest subscriber: print where the object is whenever a touch has ended.
// Debian: cppzmq-dev libmsgpack-cxx-dev; g++ -std=c++17 -O2 subscribe.cpp -o subscribe -lzmq
#include <cstdio>
#include <cstdlib>
#include <map>
#include <msgpack.hpp>
#include <vector>
#include <zmq_addon.hpp>

using Map = std::map<std::string, msgpack::object>;

constexpr int CONVERGED = 3;  // of `status`: docs/stream.md has all numbers

int main(int argc, char** argv) {
    zmq::context_t context;
    zmq::socket_t socket(context, zmq::socket_type::sub);
    // of the service, and of a daemon that this user runs: whichever is there, or comes later
    const char* own = std::getenv("XDG_RUNTIME_DIR");
    std::vector<std::string> usual = {"ipc:///run/taxeld/stream",
                                      "ipc://" + std::string(own ? own : "/nowhere") + "/taxeld/stream"};
    for (auto& endpoint : argc > 1 ? std::vector<std::string>{argv[1]} : usual) {
        socket.connect(endpoint);
        std::fprintf(stderr, "listening at %s\n", endpoint.c_str());
    }
    socket.set(zmq::sockopt::subscribe, "/taxeld/estimate");
    for (bool touching = false;;) {
        std::vector<zmq::message_t> frames;  // topic, map, time
        (void)zmq::recv_multipart(socket, std::back_inserter(frames));
        auto held = msgpack::unpack(frames.at(1).data<char>(), frames.at(1).size());
        auto estimate = held->as<Map>();
        bool usable = estimate["valid"].as<bool>() && estimate["status"].as<int>() == CONVERGED;
        if (touching && !estimate["contact"].as<bool>() && usable) {
            auto pose = estimate["map"].as<std::map<std::string, double>>();
            std::string named;
            double most = -1.0;
            for (auto& [name, p] : estimate["objects"].as<std::map<std::string, double>>())
                if (p > most) named = name, most = p;
            std::printf("x %.3f m  y %.3f m  yaw %.2f  p %.3f  %s\n", pose["x"], pose["y"],
                        pose["theta"], estimate["p"].as<double>(), named.c_str());
            std::fflush(stdout);
        }
        touching = estimate["contact"].as<bool>();
    }
}
