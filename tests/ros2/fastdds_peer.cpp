// Fast DDS, the DDS of ROS 2's default middleware, on the other side of the bridge.
//
//     fastdds_peer hear DOMAIN    a line for each pose
//     fastdds_peer tell DOMAIN    poses on /skin, 50 a second
//
// Messages are read and written by Fast DDS's own CDR; only the order of their fields is known here.
#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstring>
#include <functional>
#include <string>
#include <thread>
#include <vector>

#include <fastcdr/Cdr.h>
#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/publisher/DataWriter.hpp>
#include <fastdds/dds/publisher/Publisher.hpp>
#include <fastdds/dds/subscriber/DataReader.hpp>
#include <fastdds/dds/subscriber/DataReaderListener.hpp>
#include <fastdds/dds/subscriber/SampleInfo.hpp>
#include <fastdds/dds/subscriber/Subscriber.hpp>
#include <fastdds/dds/topic/TopicDataType.hpp>
#include <fastdds/rtps/transport/UDPv4TransportDescriptor.h>

using namespace eprosima::fastdds::dds;
using eprosima::fastcdr::Cdr;
using eprosima::fastcdr::FastBuffer;
using eprosima::fastrtps::rtps::InstanceHandle_t;
using eprosima::fastrtps::rtps::SerializedPayload_t;

using Bytes = std::vector<char>;

// A type of which nothing is known but its name: its messages are bytes
class AnyType : public TopicDataType {
public:
    explicit AnyType(const std::string& name) {
        setName(name.c_str());
        m_typeSize = 1 << 20;
        m_isGetKeyDefined = false;
    }
    bool serialize(void* data, SerializedPayload_t* payload) override {
        auto& bytes = *static_cast<Bytes*>(data);
        std::memcpy(payload->data, bytes.data(), bytes.size());
        payload->length = static_cast<uint32_t>(bytes.size());
        payload->encapsulation = CDR_LE;
        return true;
    }
    bool deserialize(SerializedPayload_t* payload, void* data) override {
        auto* from = reinterpret_cast<char*>(payload->data);
        static_cast<Bytes*>(data)->assign(from, from + payload->length);
        return true;
    }
    std::function<uint32_t()> getSerializedSizeProvider(void* data) override {
        return [data] { return static_cast<uint32_t>(static_cast<Bytes*>(data)->size()); };
    }
    void* createData() override { return new Bytes; }
    void deleteData(void* data) override { delete static_cast<Bytes*>(data); }
    bool getKey(void*, InstanceHandle_t*, bool) override { return false; }
};

// Stamp, frame, x, y, z, yaw, and the variances of x and yaw
static void print_pose(Cdr& in) {
    int32_t sec;
    uint32_t nanosec;
    std::string frame;
    in >> sec >> nanosec >> frame;
    double v[7 + 36];
    for (auto& d : v) in >> d;
    std::printf("%d.%09u %s %.17g %.17g %.17g %.17g %.17g %.17g\n", sec, nanosec, frame.c_str(),
                v[0], v[1], v[2], 2 * std::atan2(v[5], v[6]), v[7], v[7 + 35]);
    std::fflush(stdout);
}

class Hearer : public DataReaderListener {
    void on_data_available(DataReader* reader) override {
        Bytes bytes;
        SampleInfo info;
        while (reader->take_next_sample(&bytes, &info) == ReturnCode_t::RETCODE_OK) {
            if (!info.valid_data) continue;
            FastBuffer buffer(bytes.data(), bytes.size());
            Cdr in(buffer, Cdr::DEFAULT_ENDIAN, Cdr::DDS_CDR);
            in.read_encapsulation();
            print_pose(in);
        }
    }
};

static DomainParticipant* participant(uint32_t domain) {
    auto udp = std::make_shared<eprosima::fastdds::rtps::UDPv4TransportDescriptor>();
    udp->interfaceWhiteList.push_back("127.0.0.1");
    DomainParticipantQos qos;
    qos.transport().use_builtin_transports = false;
    qos.transport().user_transports.push_back(udp);
    for (uint32_t k = 0; k < 20; ++k) {  // no multicast: the first participants are asked
        eprosima::fastrtps::rtps::Locator_t peer;
        eprosima::fastrtps::rtps::IPLocator::setIPv4(peer, "127.0.0.1");
        peer.port = 7400 + 250 * domain + 10 + 2 * k;
        qos.wire_protocol().builtin.initialPeersList.push_back(peer);
    }
    return DomainParticipantFactory::get_instance()->create_participant(domain, qos);
}

static Topic* topic(DomainParticipant* dds, const char* name, const char* type) {
    TypeSupport(new AnyType(type)).register_type(dds);
    return dds->create_topic(name, type, TOPIC_QOS_DEFAULT);
}

static void hear(DomainParticipant* dds) {
    DataReaderQos qos;
    qos.reliability().kind = RELIABLE_RELIABILITY_QOS;
    const char* type = "geometry_msgs::msg::dds_::PoseWithCovarianceStamped_";
    dds->create_subscriber(SUBSCRIBER_QOS_DEFAULT)
        ->create_datareader(topic(dds, "rt/taxeld/pose", type), qos, new Hearer);
    for (;;) std::this_thread::sleep_for(std::chrono::seconds(1));
}

// A geometry_msgs/msg/PoseStamped of now
static Bytes pose(double x, double yaw) {
    auto ns = std::chrono::duration_cast<std::chrono::nanoseconds>(
                  std::chrono::system_clock::now().time_since_epoch()).count();
    FastBuffer buffer;
    Cdr out(buffer, Cdr::LITTLE_ENDIANNESS, Cdr::DDS_CDR);
    out.serialize_encapsulation();
    out << int32_t(ns / 1000000000) << uint32_t(ns % 1000000000) << std::string("world");
    out << x << 0.25 << 0.5 << 0.0 << 0.0 << std::sin(yaw / 2) << std::cos(yaw / 2);
    return Bytes(out.getBufferPointer(), out.getBufferPointer() + out.getSerializedDataLength());
}

static void tell(DomainParticipant* dds) {
    auto* written = topic(dds, "rt/skin", "geometry_msgs::msg::dds_::PoseStamped_");
    auto* writer = dds->create_publisher(PUBLISHER_QOS_DEFAULT)
                       ->create_datawriter(written, DATAWRITER_QOS_DEFAULT);
    for (;; std::this_thread::sleep_for(std::chrono::milliseconds(20))) {
        auto now = pose(1.0, M_PI / 2);
        writer->write(&now);
    }
}

int main(int argc, char** argv) {
    if (argc != 3) return 2;
    auto* dds = participant(static_cast<uint32_t>(std::stoul(argv[2])));
    if (dds == nullptr) return 1;
    std::strcmp(argv[1], "hear") == 0 ? hear(dds) : tell(dds);
}
