/* SPDX-License-Identifier: BSD-3-Clause
 *
 * taxeld_protocol.h: CySkin packets on CAN and on taxeld's serial link, for hubs (IHBs) and other
 * microcontrollers. C99 (and C++), no allocation, nothing of libc but memcpy and memset, no
 * global state.
 *
 * In one source file define TAXELD_PROTOCOL_IMPLEMENTATION before including this; elsewhere just
 * include it. The encoded packet is the common coin: builders write one, a fragmenter turns it into
 * CAN frames, taxeld_serial_encode into a line; a reassembler (CAN) or a receiver (serial) gives
 * packets back. Functions that answer `int` answer a taxeld_status where it is negative.
 *
 * An IHB that sends one scan on CAN:
 *
 *     static const uint8_t channels[] = {11, 11, 8};  // of each module
 *
 *     void scan_to_can(const uint16_t *counts, size_t n)
 *     {
 *         uint8_t packet[TAXELD_PACKET_MAX];
 *         taxeld_scan scan;
 *         taxeld_fragmenter fragments;
 *         taxeld_frame frame;
 *         int len = taxeld_scan_init(&scan, channels, sizeof channels, 0, 0, counts, n);
 *
 *         while (len >= 0 && (len = taxeld_scan_next(&scan, packet, sizeof packet)) > 0) {
 *             taxeld_fragmenter_init(&fragments, packet, (size_t)len, SHORT_ID);
 *             while (taxeld_fragmenter_next(&fragments, &frame))
 *                 can_send(frame.id, frame.data, frame.len);
 *         }
 *     }
 *
 * On serial the loop's body is:
 *
 *     uint8_t line[TAXELD_LINE_MAX];
 *     len = taxeld_serial_encode(line, sizeof line, packet, (size_t)len, SHORT_ID);
 *     if (len > 0)
 *         uart_write(line, (size_t)len);
 *
 * Requests: one reassembler for the hub's own short id and one for TAXELD_BROADCAST; feed both
 * every frame, and take the packet from whichever answers TAXELD_GOOD. A taxeld_hub answers it, as
 * hub_main.c shows for CAN and own_skin.c for a serial line. On serial:
 *
 *     while (taxeld_receiver_take(&receiver, &data, &n, &packet) == TAXELD_GOOD)
 *         answer(&packet);
 */
#ifndef TAXELD_PROTOCOL_H
#define TAXELD_PROTOCOL_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define TAXELD_PROTOCOL_VERSION_MAJOR 0
#define TAXELD_PROTOCOL_VERSION_MINOR 3
#define TAXELD_PROTOCOL_VERSION_PATCH 0
#define TAXELD_PROTOCOL_VERSION 300L /* MAJOR * 10000 + MINOR * 100 + PATCH, for #if */

#define TAXELD_FIRST 0x100u /* assembly bits of an 11-bit id */
#define TAXELD_MIDDLE 0x200u
#define TAXELD_LAST 0x400u
#define TAXELD_SINGLE 0x500u
#define TAXELD_ASSEMBLY_MASK 0x700u
#define TAXELD_SHORT_ID_MASK 0x0FFu
#define TAXELD_BROADCAST 0xFFu

#define TAXELD_FRAGMENT_BYTES 8u
#define TAXELD_PAYLOAD_MAX 255u
#define TAXELD_PACKET_MAX (TAXELD_PAYLOAD_MAX + 3u) /* command, N, payload, CRC-8 */
#define TAXELD_FRAGMENTS_MAX ((TAXELD_PACKET_MAX + 7u) / 8u)
#define TAXELD_VALUES_MAX 126u /* of a SENSOR_DATA packet */
#define TAXELD_NAMES 12u       /* T0..T11, so channels of a module at most */
#define TAXELD_MODULES_MAX 248u
#define TAXELD_ALL_NAMES 0xFFFu /* the mask of a module of which nothing is cut */
#define TAXELD_ALL_MODULES 0xFFu

#define TAXELD_COBS_MAX(n) ((n) + (n) / 254u + 1u)         /* room that n bytes may take encoded */
#define TAXELD_PLAIN_MAX (1u + 2u + TAXELD_PAYLOAD_MAX + 2u) /* short id .. CRC-16 */
#define TAXELD_LINE_MAX (TAXELD_COBS_MAX(TAXELD_PLAIN_MAX) + 1u) /* with its delimiter */

typedef enum {
    TAXELD_DISCOVERY_PING = 0x10,
    TAXELD_DISCOVERY_RECV_ID = 0x11,
    TAXELD_PING = 0x12,
    TAXELD_ERROR = 0x13,
    TAXELD_MODULE_PROGRAM_END = 0x31,
    TAXELD_IHB_COLD_REBOOT = 0x32,
    TAXELD_IHB_WARM_REBOOT = 0x33,
    TAXELD_MODULE_COLD_REBOOT = 0x34,
    TAXELD_MODULE_WARM_REBOOT = 0x35,
    TAXELD_SET_MODULE_GROUPING = 0x36,
    TAXELD_SET_AUTO_SYNC = 0x37,
    TAXELD_SET_AUTO_SYNC_PERIOD = 0x38,
    TAXELD_SET_COMM_SPEED = 0x39,
    TAXELD_GET_COMM_SPEED = 0x3A,
    TAXELD_SYNC = 0x3B,
    TAXELD_DECLARE = 0x3C,
    TAXELD_MODULE_DETAILS = 0x3D,
    TAXELD_VERSION = 0x3E,
    TAXELD_MODULE_BTLDR_VERSION = 0x3F,
    TAXELD_MODULE_APP_VERSION = 0x40,
    TAXELD_UID = 0x41,
    TAXELD_MODULE_CDC_SPEED = 0x42,
    TAXELD_SENSOR_DATA = 0x43,
    TAXELD_MODULE_CDC_CONTROL = 0x44,
    TAXELD_MODULE_PHASE_SHIFT = 0x45,
    TAXELD_MODULE_SET_CUT_SENSORS = 0x47
} taxeld_command;

typedef enum { /* why a request fails: the byte behind its command in an ERROR */
    TAXELD_ERROR_FAIL = 0xE1,
    TAXELD_ERROR_NOT_SUPPORTED = 0xE2,
    TAXELD_ERROR_INVALID = 0xE3,
    TAXELD_ERROR_NO_COMMAND = 0xE4,
    TAXELD_ERROR_NO_ARGUMENT = 0xE5,
    TAXELD_ERROR_FORMAT = 0xE6,
    TAXELD_ERROR_CRC = 0xE7,
    TAXELD_ERROR_NO_BUFFERS = 0xE8,
    TAXELD_ERROR_PHASE = 0xE9,
    TAXELD_ERROR_BUSY = 0xEA,
    TAXELD_ERROR_IO = 0xEB
} taxeld_error;

typedef enum {
    TAXELD_WAITING = 0, /* taken; no packet yet */
    TAXELD_GOOD = 1,    /* a packet was delivered */
    TAXELD_E_ARGUMENT = -1, /* what the wire cannot carry */
    TAXELD_E_ROOM = -2,     /* the caller's buffer may not hold the result */
    TAXELD_E_LENGTH = -3,
    TAXELD_E_CRC = -4,
    TAXELD_E_ORPHAN = -5,  /* a middle or last fragment without a first */
    TAXELD_E_FOREIGN = -6, /* a frame that is no fragment */
    TAXELD_E_COBS = -7
} taxeld_status;

/* A packet whose length and checksum are right. `payload` points into what it was read from. */
typedef struct {
    uint8_t ihb; /* short id: sender of a response, receiver of a request */
    uint8_t command;
    uint8_t n;
    const uint8_t *payload;
} taxeld_packet;

typedef struct {
    uint32_t id;
    bool extended; /* a 29-bit id */
    uint8_t len;   /* at most 8 */
    uint8_t data[TAXELD_FRAGMENT_BYTES];
} taxeld_frame;

/* What MODULE_DETAILS tells of a module. Its channels are those possible: 12, or the bits of the mask,
 * which is what the module sends and what DECLARE has to tell. MODULE_SET_CUT_SENSORS names the taxels
 * that are cut: mask = TAXELD_ALL_NAMES & ~cut. */
typedef struct {
    uint32_t sui; /* serial number: a taxel's UID is sui << 4 | name */
    uint16_t mask; /* uncut taxels, LSB = T0 */
    uint8_t channels;
    uint8_t grouping;
    uint8_t cdc_control;
    uint8_t cdc_speed;
} taxeld_module;

/* The fields of a request; those that its command does not have are 0. */
typedef struct {
    uint32_t uid;       /* DISCOVERY_RECV_ID: of the hub that is meant */
    uint8_t short_id;   /* DISCOVERY_RECV_ID: what the hub is called from now on */
    bool on;            /* SET_AUTO_SYNC */
    uint16_t period_ms; /* SET_AUTO_SYNC_PERIOD */
    uint8_t module;     /* MODULE_DETAILS, MODULE_SET_CUT_SENSORS: its index, or TAXELD_ALL_MODULES */
    uint16_t cut;       /* MODULE_SET_CUT_SENSORS: taxels to cut, LSB = T0 */
} taxeld_request;

typedef enum {
    TAXELD_BOOTLOADER, /* the hub's own */
    TAXELD_MODULES,    /* its modules' */
    TAXELD_RUNNING
} taxeld_phase;

/* A hub as the host sees it; begin it by taxeld_hub_init. */
typedef struct {
    uint32_t uid; /* no other hub on the line has it */
    const taxeld_module *module;
    size_t modules;
    taxeld_phase phase;
    uint8_t short_id;
    bool auto_sync; /* a scan is to be sent each period_ms */
    uint16_t period_ms;
    uint8_t asked, error; /* what is being answered */
    size_t at, end;       /* the next answer, and where they end */
} taxeld_hub;

uint8_t taxeld_crc8(const uint8_t *data, size_t n);   /* 0xFB over "123456789" */
uint16_t taxeld_crc16(const uint8_t *data, size_t n); /* 0x29B1 over "123456789" */

/* Builders: the length of the packet written to `out`. While modules are in their bootloader a hub
 * answers DECLARE with their number alone (one byte), and MODULE_DETAILS with index and sui (five):
 * taxeld_packet_encode makes these. */
int taxeld_packet_encode(uint8_t *out, size_t room, uint8_t command, const uint8_t *payload,
                         size_t n);
int taxeld_discovery_encode(uint8_t *out, size_t room, uint32_t uid);
int taxeld_declare_encode(uint8_t *out, size_t room, const uint8_t *channels, size_t modules);
int taxeld_details_encode(uint8_t *out, size_t room, uint8_t index, const taxeld_module *module);

/* TAXELD_GOOD, TAXELD_E_LENGTH or TAXELD_E_CRC. After the packet there may be seven bytes, as the last
 * fragment's padding; more are of another packet, whose fragments were mixed in. Leaves packet->ihb
 * alone, as an encoded packet does not name it. */
int taxeld_packet_parse(taxeld_packet *packet, const uint8_t *data, size_t len);

/* False where the payload is longer or shorter than the fields of the command, as in another hub's
 * answer: nothing of it is to be obeyed. Commands that no bring-up asks are not looked into. */
bool taxeld_request_parse(taxeld_request *request, const taxeld_packet *packet);

/* `phase`: after power-on; a hub whose modules have no bootloader is TAXELD_RUNNING. The modules have
 * to outlive it. */
void taxeld_hub_init(taxeld_hub *hub, uint32_t uid, const taxeld_module *module, size_t modules,
                     taxeld_phase phase);
/* Do what the host's bring-up asks for; of other requests the answer is an ERROR. On CAN the frame that
 * ends a hub's bootloader is no packet: set `phase`. A new short_id needs a new reassembler. */
void taxeld_hub_hear(taxeld_hub *hub, const taxeld_packet *request);
/* The length of the next answer, 0 after the last. */
int taxeld_hub_answer(taxeld_hub *hub, uint8_t *out, size_t room);
/* How many channels each module sends: the bits of its mask. */
void taxeld_channels(uint8_t *channels, const taxeld_module *module, size_t modules);

/* One scan as SENSOR_DATA packets. What it was begun with has to outlive it. */
typedef struct {
    const uint8_t *channels;
    size_t modules;
    size_t module, channel; /* of the next value */
    const uint16_t *counts;
    size_t left;
} taxeld_scan;

/* `counts`: n values, channel by channel from (module, channel) on; a whole scan starts at (0, 0).
 * TAXELD_E_ARGUMENT if the modules have no such channels. */
int taxeld_scan_init(taxeld_scan *scan, const uint8_t *channels, size_t modules, size_t module,
                     size_t channel, const uint16_t *counts, size_t n);
/* The length of the next packet, 0 after the last. */
int taxeld_scan_next(taxeld_scan *scan, uint8_t *out, size_t room);

/* An encoded packet as CAN frames. The packet has to outlive it. */
typedef struct {
    const uint8_t *packet;
    size_t len, at;
    uint8_t ihb;
} taxeld_fragmenter;

int taxeld_fragmenter_init(taxeld_fragmenter *fragmenter, const uint8_t *packet, size_t len,
                           uint8_t ihb);
bool taxeld_fragmenter_next(taxeld_fragmenter *fragmenter, taxeld_frame *frame);

/* Every frame fed is in `used` or one of the four drops, or still pending. */
typedef struct {
    uint32_t frames;
    uint32_t used;    /* carried a good packet */
    uint32_t foreign; /* extended ids and ids that are no fragment */
    uint32_t orphan;
    uint32_t length;
    uint32_t crc;
    uint32_t packets, length_errors, crc_errors; /* packets, not frames */
} taxeld_link_counters;

/* CAN frames -> packets of one short id. */
typedef struct {
    uint8_t data[TAXELD_FRAGMENTS_MAX * TAXELD_FRAGMENT_BYTES];
    size_t len;
    uint32_t pending; /* frames held for a packet that is not complete */
    uint8_t short_id;
    taxeld_link_counters counters;
} taxeld_reassembler;

void taxeld_reassembler_init(taxeld_reassembler *reassembler, uint8_t short_id);
/* TAXELD_GOOD with a packet valid until the next call, TAXELD_WAITING, or why the frame was
 * dropped. Frames of other short ids are passed over and not counted. */
int taxeld_reassembler_feed(taxeld_reassembler *reassembler, const taxeld_frame *frame,
                            taxeld_packet *packet);

/* Consistent overhead byte stuffing, without the delimiter: the length of the result. Data are at
 * most TAXELD_COBS_DATA_MAX bytes. Encoding asks for TAXELD_COBS_MAX(n) bytes of room; decoding may
 * be done in place. */
#define TAXELD_COBS_DATA_MAX 32000u /* the result fits an int of 16 bits */
int taxeld_cobs_encode(uint8_t *out, size_t room, const uint8_t *data, size_t n);
int taxeld_cobs_decode(uint8_t *out, size_t room, const uint8_t *data, size_t n);

/* An encoded packet as its line, delimiter included: the line's length. */
int taxeld_serial_encode(uint8_t *out, size_t room, const uint8_t *packet, size_t len,
                         uint8_t ihb);

/* Bytes fed that are neither used nor held for a line under way were dropped. */
typedef struct {
    uint32_t bytes;
    uint32_t used;
    uint32_t packets;
    uint32_t length_errors;
    uint32_t crc_errors;
} taxeld_serial_counters;

/* Serial bytes -> packets. A line that is too long is dropped up to its delimiter. */
typedef struct {
    uint8_t line[TAXELD_LINE_MAX - 1u];
    size_t len;
    bool overrun;
    taxeld_serial_counters counters;
} taxeld_receiver;

void taxeld_receiver_init(taxeld_receiver *receiver);
/* TAXELD_GOOD with a packet valid until the next call, TAXELD_WAITING, or why a line was
 * dropped. */
int taxeld_receiver_feed(taxeld_receiver *receiver, uint8_t byte, taxeld_packet *packet);
/* Takes bytes from *data up to a good packet (TAXELD_GOOD; call again) or the end (TAXELD_WAITING);
 * bad lines are counted and passed over. */
int taxeld_receiver_take(taxeld_receiver *receiver, const uint8_t **data, size_t *n,
                         taxeld_packet *packet);

#ifdef __cplusplus
}
#endif
#endif /* TAXELD_PROTOCOL_H */

#ifdef TAXELD_PROTOCOL_IMPLEMENTATION
#ifndef TAXELD_PROTOCOL_IMPLEMENTED
#define TAXELD_PROTOCOL_IMPLEMENTED

#include <string.h>

/* Checksums go bit by bit: a scan of 700 taxels costs some 12 000 steps, and no table in flash. */
uint8_t taxeld_crc8(const uint8_t *data, size_t n)
{
    unsigned crc = 0xFFu;

    while (n--) {
        crc ^= *data++;
        for (int bit = 0; bit < 8; bit++)
            crc = crc & 0x80u ? (crc << 1 ^ 0x07u) & 0xFFu : crc << 1;
    }
    return (uint8_t)crc;
}

uint16_t taxeld_crc16(const uint8_t *data, size_t n)
{
    unsigned crc = 0xFFFFu;

    while (n--) {
        crc ^= (unsigned)*data++ << 8;
        for (int bit = 0; bit < 8; bit++)
            crc = (crc & 0x8000u ? crc << 1 ^ 0x1021u : crc << 1) & 0xFFFFu;
    }
    return (uint16_t)crc;
}

static void taxeld__put_u16(uint8_t *out, unsigned value)
{
    out[0] = (uint8_t)(value >> 8);
    out[1] = (uint8_t)value;
}

static void taxeld__put_u32(uint8_t *out, uint32_t value)
{
    taxeld__put_u16(out, (unsigned)(value >> 16));
    taxeld__put_u16(out + 2, (unsigned)(value & 0xFFFFu));
}

static uint16_t taxeld__get_u16(const uint8_t *data)
{
    return (uint16_t)(data[0] << 8 | data[1]);
}

/* Write what surrounds the n bytes of payload that stand at out + 2. */
static int taxeld__seal(uint8_t *out, uint8_t command, size_t n)
{
    out[0] = command;
    out[1] = (uint8_t)n;
    out[2 + n] = taxeld_crc8(out, 2 + n);
    return (int)n + 3;
}

int taxeld_packet_encode(uint8_t *out, size_t room, uint8_t command, const uint8_t *payload,
                         size_t n)
{
    if (n > TAXELD_PAYLOAD_MAX)
        return TAXELD_E_ARGUMENT;
    if (room < n + 3)
        return TAXELD_E_ROOM;
    if (n) /* an empty payload may be NULL */
        memcpy(out + 2, payload, n);
    return taxeld__seal(out, command, n);
}

int taxeld_discovery_encode(uint8_t *out, size_t room, uint32_t uid)
{
    uint8_t payload[4];

    taxeld__put_u32(payload, uid);
    return taxeld_packet_encode(out, room, TAXELD_DISCOVERY_PING, payload, sizeof payload);
}

int taxeld_declare_encode(uint8_t *out, size_t room, const uint8_t *channels, size_t modules)
{
    if (modules > TAXELD_MODULES_MAX)
        return TAXELD_E_ARGUMENT;
    for (size_t i = 0; i < modules; i++)
        if (channels[i] > TAXELD_NAMES)
            return TAXELD_E_ARGUMENT;
    if (room < modules + 5)
        return TAXELD_E_ROOM;
    out[2] = (uint8_t)modules;
    out[3] = 0; /* first module */
    if (modules)
        memcpy(out + 4, channels, modules);
    return taxeld__seal(out, TAXELD_DECLARE, modules + 2);
}

int taxeld_details_encode(uint8_t *out, size_t room, uint8_t index, const taxeld_module *module)
{
    if (index >= TAXELD_MODULES_MAX || module->channels > TAXELD_NAMES ||
        module->mask >> TAXELD_NAMES)
        return TAXELD_E_ARGUMENT;
    if (room < 14)
        return TAXELD_E_ROOM;
    out[2] = index;
    taxeld__put_u32(out + 3, module->sui);
    out[7] = module->channels;
    out[8] = module->grouping;
    taxeld__put_u16(out + 9, module->mask);
    out[11] = module->cdc_control;
    out[12] = module->cdc_speed;
    return taxeld__seal(out, TAXELD_MODULE_DETAILS, 11);
}

int taxeld_packet_parse(taxeld_packet *packet, const uint8_t *data, size_t len)
{
    if (len <= 2 || len < data[1] + 3u || len - (data[1] + 3u) >= TAXELD_FRAGMENT_BYTES)
        return TAXELD_E_LENGTH;
    if (taxeld_crc8(data, data[1] + 2u) != data[data[1] + 2u])
        return TAXELD_E_CRC;
    packet->command = data[0];
    packet->n = data[1];
    packet->payload = data + 2;
    return TAXELD_GOOD;
}

bool taxeld_request_parse(taxeld_request *request, const taxeld_packet *packet)
{
    static const uint8_t lengths[][2] = {
        {TAXELD_DISCOVERY_PING, 0}, {TAXELD_DISCOVERY_RECV_ID, 5},
        {TAXELD_DECLARE, 0},        {TAXELD_MODULE_DETAILS, 1},
        {TAXELD_SET_AUTO_SYNC, 1},  {TAXELD_SET_AUTO_SYNC_PERIOD, 2},
        {TAXELD_MODULE_PROGRAM_END, 0}, {TAXELD_MODULE_SET_CUT_SENSORS, 3},
    };
    static const taxeld_request none = {0, 0, false, 0, 0, 0};
    const uint8_t command = packet->command, *p = packet->payload;

    *request = none;
    for (size_t i = 0; i < sizeof lengths / sizeof *lengths; i++)
        if (lengths[i][0] == command && lengths[i][1] != packet->n)
            return false;
    if (command == TAXELD_DISCOVERY_RECV_ID) {
        request->uid = (uint32_t)taxeld__get_u16(p) << 16 | taxeld__get_u16(p + 2);
        request->short_id = p[4];
    }
    if (command == TAXELD_SET_AUTO_SYNC)
        request->on = p[0] != 0;
    if (command == TAXELD_SET_AUTO_SYNC_PERIOD)
        request->period_ms = taxeld__get_u16(p);
    if (command == TAXELD_MODULE_DETAILS || command == TAXELD_MODULE_SET_CUT_SENSORS)
        request->module = p[0];
    if (command == TAXELD_MODULE_SET_CUT_SENSORS)
        request->cut = taxeld__get_u16(p + 1);
    return true;
}

void taxeld_hub_init(taxeld_hub *hub, uint32_t uid, const taxeld_module *module, size_t modules,
                     taxeld_phase phase)
{
    const taxeld_hub begun = {uid, module, modules, phase, 1, false, 50, 0, 0, 0, 0};

    *hub = begun;
}

/* Set which answers a question has: 0, or a taxeld_error. */
static uint8_t taxeld__ask(taxeld_hub *hub, uint8_t command, uint8_t module)
{
    const bool all = module == TAXELD_ALL_MODULES;

    if (command == TAXELD_DISCOVERY_PING || command == TAXELD_DECLARE) {
        hub->end = 1;
        return 0;
    }
    if (command != TAXELD_MODULE_DETAILS)
        return TAXELD_ERROR_NOT_SUPPORTED;
    if (!all && module >= hub->modules)
        return TAXELD_ERROR_INVALID;
    hub->at = all ? 0 : module;
    hub->end = all ? hub->modules : module + 1u;
    return 0;
}

/* Do what is asked for: 0, or the taxeld_error that says why not. Apart from the questions, since a
 * switch with more cases becomes a table, which on small cores needs the compiler's library. */
static uint8_t taxeld__obey(taxeld_hub *hub, const taxeld_packet *packet)
{
    const bool early = hub->phase < TAXELD_RUNNING;
    taxeld_request asked;

    if (!taxeld_request_parse(&asked, packet))
        return TAXELD_ERROR_FORMAT;
    switch (packet->command) {
    case TAXELD_DISCOVERY_RECV_ID:
        if (asked.uid != hub->uid)
            return 0;
        if (asked.short_id == 0 || asked.short_id == TAXELD_BROADCAST)
            return TAXELD_ERROR_INVALID;
        hub->short_id = asked.short_id;
        hub->end = 1;
        return 0;
    case TAXELD_MODULE_PROGRAM_END:
        if (hub->phase == TAXELD_BOOTLOADER)
            return TAXELD_ERROR_PHASE;
        hub->phase = TAXELD_RUNNING;
        return 0;
    case TAXELD_SET_AUTO_SYNC:
        if (asked.on && early)
            return TAXELD_ERROR_PHASE;
        hub->auto_sync = asked.on;
        return 0;
    case TAXELD_SET_AUTO_SYNC_PERIOD:
        if (early)
            return TAXELD_ERROR_PHASE;
        if (asked.period_ms == 0)
            return TAXELD_ERROR_INVALID;
        hub->period_ms = asked.period_ms;
        return 0;
    default:
        return taxeld__ask(hub, packet->command, asked.module);
    }
}

void taxeld_hub_hear(taxeld_hub *hub, const taxeld_packet *request)
{
    hub->at = hub->end = 0;
    if (request->command == TAXELD_ERROR ||
        (request->ihb != hub->short_id && request->ihb != TAXELD_BROADCAST))
        return;
    hub->asked = request->command;
    hub->error = taxeld__obey(hub, request);
    if (hub->error)
        hub->end = 1;
}

static int taxeld__hub_declare(const taxeld_hub *hub, uint8_t *out, size_t room)
{
    const size_t n = hub->phase < TAXELD_RUNNING ? 1 : hub->modules + 2;

    if (hub->modules > TAXELD_MODULES_MAX)
        return TAXELD_E_ARGUMENT;
    if (room < n + 3)
        return TAXELD_E_ROOM;
    out[2] = (uint8_t)hub->modules;
    if (n > 1) {
        out[3] = 0; /* first module */
        taxeld_channels(out + 4, hub->module, hub->modules);
    }
    return taxeld__seal(out, TAXELD_DECLARE, n);
}

int taxeld_hub_answer(taxeld_hub *hub, uint8_t *out, size_t room)
{
    const uint8_t failed[] = {hub->asked, hub->error};
    const size_t i = hub->at;
    uint8_t early[5];

    if (i >= hub->end)
        return 0;
    hub->at++;
    if (hub->error)
        return taxeld_packet_encode(out, room, TAXELD_ERROR, failed, sizeof failed);
    if (hub->asked == TAXELD_DISCOVERY_PING)
        return taxeld_discovery_encode(out, room, hub->uid);
    if (hub->asked == TAXELD_DECLARE)
        return taxeld__hub_declare(hub, out, room);
    if (hub->asked != TAXELD_MODULE_DETAILS)
        return taxeld_packet_encode(out, room, hub->asked, NULL, 0);
    if (hub->phase == TAXELD_RUNNING)
        return taxeld_details_encode(out, room, (uint8_t)i, &hub->module[i]);
    early[0] = (uint8_t)i;
    taxeld__put_u32(early + 1, hub->module[i].sui);
    return taxeld_packet_encode(out, room, hub->asked, early, sizeof early);
}

void taxeld_channels(uint8_t *channels, const taxeld_module *module, size_t modules)
{
    for (size_t i = 0; i < modules; i++) {
        channels[i] = 0;
        for (unsigned mask = module[i].mask; mask; mask &= mask - 1)
            channels[i]++;
    }
}

/* Go on to the next channel that exists; one past the last is (modules, 0). */
static void taxeld__settle(taxeld_scan *scan)
{
    while (scan->module < scan->modules && scan->channel >= scan->channels[scan->module]) {
        scan->module++;
        scan->channel = 0;
    }
}

int taxeld_scan_init(taxeld_scan *scan, const uint8_t *channels, size_t modules, size_t module,
                     size_t channel, const uint16_t *counts, size_t n)
{
    const taxeld_scan start = {channels, modules, module, channel, counts, n};
    size_t rest = 0;

    scan->left = 0; /* a scan that was refused sends nothing */
    if (modules > TAXELD_MODULES_MAX || module > modules)
        return TAXELD_E_ARGUMENT;
    for (size_t i = 0; i < modules; i++) {
        if (channels[i] > TAXELD_NAMES)
            return TAXELD_E_ARGUMENT;
        rest += i < module ? 0 : channels[i];
    }
    if (channel && (module == modules || channel >= channels[module]))
        return TAXELD_E_ARGUMENT;
    if (n > rest - channel)
        return TAXELD_E_ARGUMENT;
    *scan = start;
    taxeld__settle(scan);
    return 0;
}

int taxeld_scan_next(taxeld_scan *scan, uint8_t *out, size_t room)
{
    const size_t n = scan->left < TAXELD_VALUES_MAX ? scan->left : TAXELD_VALUES_MAX;

    if (n == 0)
        return 0;
    if (room < 2 * n + 5)
        return TAXELD_E_ROOM; /* and the scan stands where it stood */
    out[2] = (uint8_t)scan->module;
    out[3] = (uint8_t)scan->channel;
    for (size_t i = 0; i < n; i++) {
        taxeld__put_u16(out + 4 + 2 * i, *scan->counts++);
        scan->channel++;
        taxeld__settle(scan);
    }
    scan->left -= n;
    return taxeld__seal(out, TAXELD_SENSOR_DATA, 2 * n + 2);
}

int taxeld_fragmenter_init(taxeld_fragmenter *fragmenter, const uint8_t *packet, size_t len,
                           uint8_t ihb)
{
    const bool fits = len > 0 && len <= TAXELD_PACKET_MAX;

    fragmenter->packet = packet;
    fragmenter->len = fits ? len : 0; /* a packet that was refused has no frames */
    fragmenter->at = 0;
    fragmenter->ihb = ihb;
    return fits ? 0 : TAXELD_E_LENGTH;
}

bool taxeld_fragmenter_next(taxeld_fragmenter *fragmenter, taxeld_frame *frame)
{
    const size_t left = fragmenter->len - fragmenter->at;
    const size_t n = left < TAXELD_FRAGMENT_BYTES ? left : TAXELD_FRAGMENT_BYTES;
    const bool first = fragmenter->at == 0, last = n == left;

    if (left == 0)
        return false;
    frame->id = fragmenter->ihb;
    frame->id |= first && last ? TAXELD_SINGLE
                 : first       ? TAXELD_FIRST
                 : last        ? TAXELD_LAST
                               : TAXELD_MIDDLE;
    frame->extended = false;
    frame->len = (uint8_t)n;
    memcpy(frame->data, fragmenter->packet + fragmenter->at, n);
    fragmenter->at += n;
    return true;
}

void taxeld_reassembler_init(taxeld_reassembler *reassembler, uint8_t short_id)
{
    static const taxeld_link_counters none = {0, 0, 0, 0, 0, 0, 0, 0, 0};

    reassembler->len = 0;
    reassembler->pending = 0;
    reassembler->short_id = short_id;
    reassembler->counters = none;
}

/* Count the frames held by what became of them, and hold none. */
static int taxeld__close(taxeld_reassembler *reassembler, int status)
{
    taxeld_link_counters *counters = &reassembler->counters;
    const uint32_t frames = reassembler->pending;

    reassembler->pending = 0;
    reassembler->len = 0;
    if (status == TAXELD_GOOD) {
        counters->packets++;
        counters->used += frames;
    } else if (status == TAXELD_E_CRC) {
        counters->crc_errors++;
        counters->crc += frames;
    } else {
        counters->length_errors++;
        counters->length += frames;
    }
    return status;
}

int taxeld_reassembler_feed(taxeld_reassembler *reassembler, const taxeld_frame *frame,
                            taxeld_packet *packet)
{
    const uint32_t kind = frame->id & TAXELD_ASSEMBLY_MASK;
    const bool opens = kind == TAXELD_FIRST || kind == TAXELD_SINGLE;
    const bool closes = kind == TAXELD_LAST || kind == TAXELD_SINGLE;

    if ((frame->id & TAXELD_SHORT_ID_MASK) != reassembler->short_id)
        return TAXELD_WAITING;
    reassembler->counters.frames++;
    if (frame->extended || frame->len > TAXELD_FRAGMENT_BYTES ||
        !(opens || closes || kind == TAXELD_MIDDLE)) {
        reassembler->counters.foreign++;
        return TAXELD_E_FOREIGN;
    }
    if (opens && reassembler->pending)
        taxeld__close(reassembler, TAXELD_E_LENGTH); /* its last fragment was lost */
    if (!opens && !reassembler->pending) {
        reassembler->counters.orphan++;
        return TAXELD_E_ORPHAN;
    }
    memcpy(reassembler->data + reassembler->len, frame->data, frame->len);
    reassembler->len += frame->len;
    reassembler->pending++;
    if (closes) {
        packet->ihb = reassembler->short_id;
        return taxeld__close(reassembler,
                             taxeld_packet_parse(packet, reassembler->data, reassembler->len));
    }
    if (reassembler->pending >= TAXELD_FRAGMENTS_MAX) /* full, and still not the last */
        return taxeld__close(reassembler, TAXELD_E_LENGTH);
    return TAXELD_WAITING;
}

/* TAXELD_COBS_MAX without a division, which small cores have to call a function for: exact up to
 * TAXELD_COBS_DATA_MAX. */
static size_t taxeld__cobs_max(size_t n)
{
    return n + (size_t)((uint32_t)n * 66053u >> 24) + 1u;
}

int taxeld_cobs_encode(uint8_t *out, size_t room, const uint8_t *data, size_t n)
{
    size_t code_at = 0, at = 1;

    if (n > TAXELD_COBS_DATA_MAX)
        return TAXELD_E_ARGUMENT;
    if (room < taxeld__cobs_max(n))
        return TAXELD_E_ROOM;
    for (size_t i = 0; i < n; i++) {
        if (data[i])
            out[at++] = data[i];
        if (!data[i] || at - code_at == 255) { /* a zero, or a block of 254 bytes, ends here */
            out[code_at] = (uint8_t)(at - code_at);
            code_at = at++;
        }
    }
    out[code_at] = (uint8_t)(at - code_at);
    return (int)at;
}

int taxeld_cobs_decode(uint8_t *out, size_t room, const uint8_t *data, size_t n)
{
    size_t at = 0, written = 0;

    if (n > TAXELD_COBS_MAX(TAXELD_COBS_DATA_MAX))
        return TAXELD_E_ARGUMENT;
    while (at < n) {
        const size_t code = data[at], end = at + code;

        if (code == 0 || end > n)
            return TAXELD_E_COBS;
        if (room - written < code - 1)
            return TAXELD_E_ROOM;
        while (++at < end) {
            if (data[at] == 0)
                return TAXELD_E_COBS;
            out[written++] = data[at];
        }
        if (code < 255 && at < n) {
            if (written == room)
                return TAXELD_E_ROOM;
            out[written++] = 0;
        }
    }
    return (int)written;
}

int taxeld_serial_encode(uint8_t *out, size_t room, const uint8_t *packet, size_t len, uint8_t ihb)
{
    uint8_t plain[TAXELD_PLAIN_MAX];
    taxeld_packet parsed;
    /* a packet that was damaged in memory must not get a fresh checksum */
    const int status = taxeld_packet_parse(&parsed, packet, len);
    const size_t n = status == TAXELD_GOOD ? parsed.n + 5u : 0;

    if (status != TAXELD_GOOD)
        return status;
    if (room < taxeld__cobs_max(n) + 1)
        return TAXELD_E_ROOM;
    plain[0] = ihb;
    memcpy(plain + 1, packet, n - 3);
    taxeld__put_u16(plain + n - 2, taxeld_crc16(plain, n - 2));
    len = (size_t)taxeld_cobs_encode(out, room, plain, n);
    out[len] = 0;
    return (int)len + 1;
}

void taxeld_receiver_init(taxeld_receiver *receiver)
{
    static const taxeld_serial_counters none = {0, 0, 0, 0, 0};

    receiver->len = 0;
    receiver->overrun = false;
    receiver->counters = none;
}

/* The packet of a whole line, decoded where it stands. */
static int taxeld__line_parse(uint8_t *line, size_t len, taxeld_packet *packet)
{
    const int n = taxeld_cobs_decode(line, len, line, len);

    if (n < 0)
        return n;
    if (n < 5 || n != line[2] + 5)
        return TAXELD_E_LENGTH;
    if (taxeld_crc16(line, (size_t)n - 2) != taxeld__get_u16(line + n - 2))
        return TAXELD_E_CRC;
    packet->ihb = line[0];
    packet->command = line[1];
    packet->n = line[2];
    packet->payload = line + 3;
    return TAXELD_GOOD;
}

int taxeld_receiver_feed(taxeld_receiver *receiver, uint8_t byte, taxeld_packet *packet)
{
    taxeld_serial_counters *counters = &receiver->counters;
    const size_t len = receiver->len;
    int status;

    counters->bytes++;
    if (receiver->overrun) {
        receiver->overrun = byte != 0;
        return TAXELD_WAITING;
    }
    if (byte && len < sizeof receiver->line) {
        receiver->line[receiver->len++] = byte;
        return TAXELD_WAITING;
    }
    receiver->len = 0;
    receiver->overrun = byte != 0;
    if (len == 0) /* repeated delimiters: a way to resynchronise, no error */
        return TAXELD_WAITING;
    status = byte ? TAXELD_E_LENGTH : taxeld__line_parse(receiver->line, len, packet);
    if (status == TAXELD_GOOD) {
        counters->packets++;
        counters->used += (uint32_t)len + 1;
    } else if (status == TAXELD_E_CRC) {
        counters->crc_errors++;
    } else {
        counters->length_errors++;
    }
    return status;
}

int taxeld_receiver_take(taxeld_receiver *receiver, const uint8_t **data, size_t *n,
                         taxeld_packet *packet)
{
    while (*n) {
        (*n)--;
        if (taxeld_receiver_feed(receiver, *(*data)++, packet) == TAXELD_GOOD)
            return TAXELD_GOOD;
    }
    return TAXELD_WAITING;
}

#endif /* TAXELD_PROTOCOL_IMPLEMENTED */
#endif /* TAXELD_PROTOCOL_IMPLEMENTATION */
