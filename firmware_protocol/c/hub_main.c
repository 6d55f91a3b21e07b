/* SPDX-License-Identifier: BSD-3-Clause
 *
 * A hub (IHB) built on the library, from its bootloader to its scans: an example of how requests are
 * answered, and what the tests hold against the conversations.
 *
 *     hub_main FILE
 *
 * A line of FILE; fields are hex:
 *
 *     hub UID SHORT-ID PHASE MODULES    PHASE 0: in its bootloader, 2: its modules run; of each
 *                                       module SUI u32, mask u16, channels that DETAILS tell u8
 *     host FRAME...                     the hub hears these
 *     device FRAME...                   and has said these, and nothing before them
 *     scan COUNTS                       its channels read this, once a scan is due
 */
#include <stdio.h>
#include <stdlib.h>

#define TAXELD_PROTOCOL_IMPLEMENTATION
#include "taxeld_protocol.h"

#define TEXT_MAX 65536
#define SAID_MAX 1024

static const uint8_t leave_bootloader[] = {0x01, 0x3B, 0x00, 0x00, 0x4F, 0x6D, 0x17};
#define BOOTLOADER_ID 0x17FFFFFFu /* 29 bits */

enum { BOOTLOADER, MODULES, RUNNING }; /* the hub's own; its modules'; neither */
enum { E_PHASE = 0xE9, E_NOT_SUPPORTED = 0xE2, E_FORMAT = 0xE6 };

static struct {
    uint8_t uid[4];
    uint8_t short_id;
    int phase;
    bool auto_sync;
    unsigned period_ms;
    size_t modules;
    taxeld_module module[TAXELD_MODULES_MAX];
    taxeld_reassembler own, all;
} hub;

/* ---- The bus: here a queue that is compared with what should have been said. */

static taxeld_frame said[SAID_MAX];
static size_t n_said, n_checked;
static unsigned long line_number;

static void check_at(bool holds, const char *what, int at)
{
    if (holds)
        return;
    fprintf(stderr, "hub_main.c:%d: line %lu: not so: %s\n", at, line_number, what);
    exit(1);
}
#define CHECK(condition) check_at((condition), #condition, __LINE__)

static void can_send(const taxeld_frame *frame)
{
    CHECK(n_said < SAID_MAX);
    said[n_said++] = *frame;
}

/* ---- The hub. */

static void send(const uint8_t *packet, int len)
{
    taxeld_fragmenter fragments;
    taxeld_frame frame;

    CHECK(len > 0);
    taxeld_fragmenter_init(&fragments, packet, (size_t)len, hub.short_id);
    while (taxeld_fragmenter_next(&fragments, &frame))
        can_send(&frame);
}

static void say(uint8_t command, const uint8_t *payload, size_t n)
{
    uint8_t packet[TAXELD_PACKET_MAX];

    send(packet, taxeld_packet_encode(packet, sizeof packet, command, payload, n));
}

static void refuse(uint8_t command, uint8_t error)
{
    const uint8_t payload[] = {command, error};

    say(TAXELD_ERROR, payload, sizeof payload);
}

static void channels_of(uint8_t *channels)
{
    for (size_t i = 0; i < hub.modules; i++) {
        channels[i] = 0;
        for (unsigned mask = hub.module[i].mask; mask; mask &= mask - 1)
            channels[i]++;
    }
}

static void declare(void)
{
    uint8_t packet[TAXELD_PACKET_MAX], channels[TAXELD_MODULES_MAX];
    const uint8_t count = (uint8_t)hub.modules;

    channels_of(channels);
    if (hub.phase < RUNNING)
        say(TAXELD_DECLARE, &count, 1);
    else
        send(packet, taxeld_declare_encode(packet, sizeof packet, channels, hub.modules));
}

static void details(uint8_t index)
{
    const taxeld_module *module = &hub.module[index];
    const uint8_t early[] = {
        index, (uint8_t)(module->sui >> 24), (uint8_t)(module->sui >> 16),
        (uint8_t)(module->sui >> 8), (uint8_t)module->sui,
    };
    uint8_t packet[TAXELD_PACKET_MAX];

    if (hub.phase < RUNNING)
        say(TAXELD_MODULE_DETAILS, early, sizeof early);
    else
        send(packet, taxeld_details_encode(packet, sizeof packet, index, module));
}

static void answer(const taxeld_packet *request)
{
    const uint8_t *p = request->payload;
    const bool early = hub.phase < RUNNING;

    switch (request->command) {
    case TAXELD_DISCOVERY_PING:
        say(TAXELD_DISCOVERY_PING, hub.uid, sizeof hub.uid);
        break;
    case TAXELD_DISCOVERY_RECV_ID:
        if (request->n != 5) {
            refuse(request->command, E_FORMAT);
        } else if (memcmp(p, hub.uid, sizeof hub.uid) == 0) {
            hub.short_id = p[4];
            taxeld_reassembler_init(&hub.own, hub.short_id);
            say(TAXELD_DISCOVERY_RECV_ID, NULL, 0);
        }
        break;
    case TAXELD_DECLARE:
        declare();
        break;
    case TAXELD_MODULE_DETAILS:
        for (size_t i = 0; request->n == 1 && i < hub.modules; i++)
            if (p[0] == 0xFF || p[0] == i)
                details((uint8_t)i);
        break;
    case TAXELD_MODULE_PROGRAM_END:
        if (hub.phase == BOOTLOADER)
            refuse(request->command, E_PHASE);
        else
            hub.phase = RUNNING;
        break;
    case TAXELD_SET_AUTO_SYNC:
        if (request->n != 1)
            refuse(request->command, E_FORMAT);
        else if (early && p[0])
            refuse(request->command, E_PHASE);
        else
            hub.auto_sync = p[0] != 0;
        break;
    case TAXELD_SET_AUTO_SYNC_PERIOD:
        if (early)
            refuse(request->command, E_PHASE);
        else if (request->n == 2)
            hub.period_ms = (unsigned)p[0] << 8 | p[1];
        else
            refuse(request->command, E_FORMAT);
        break;
    default:
        refuse(request->command, E_NOT_SUPPORTED);
    }
}

static void hear(const taxeld_frame *frame)
{
    taxeld_packet request;

    if (frame->extended && frame->id == BOOTLOADER_ID && frame->len == sizeof leave_bootloader &&
        memcmp(frame->data, leave_bootloader, sizeof leave_bootloader) == 0) {
        if (hub.phase == BOOTLOADER)
            hub.phase = MODULES;
        return;
    }
    if (taxeld_reassembler_feed(&hub.own, frame, &request) == TAXELD_GOOD ||
        taxeld_reassembler_feed(&hub.all, frame, &request) == TAXELD_GOOD)
        answer(&request);
}

static void scan(const uint16_t *counts, size_t n)
{
    uint8_t packet[TAXELD_PACKET_MAX], channels[TAXELD_MODULES_MAX];
    taxeld_scan state;
    int len;

    CHECK(hub.phase == RUNNING && hub.auto_sync && hub.period_ms);
    channels_of(channels);
    CHECK(taxeld_scan_init(&state, channels, hub.modules, 0, 0, counts, n) == 0);
    while ((len = taxeld_scan_next(&state, packet, sizeof packet)) > 0)
        send(packet, len);
    CHECK(len == 0);
}

/* ---- The lines. */

static size_t unhex(const char *text, uint8_t *out, size_t room)
{
    const size_t n = strlen(text) / 2;

    CHECK(n <= room);
    for (size_t i = 0; i < n; i++) {
        const char digits[3] = {text[2 * i], text[2 * i + 1], '\0'};

        out[i] = (uint8_t)strtoul(digits, NULL, 16);
    }
    return n;
}

static taxeld_frame frame_of(char *text)
{
    taxeld_frame frame;
    char *hash = strchr(text, '#');

    CHECK(hash != NULL);
    memset(&frame, 0, sizeof frame);
    frame.id = (uint32_t)strtoul(text, NULL, 16);
    frame.extended = hash - text > 3;
    frame.len = (uint8_t)unhex(hash + 1, frame.data, sizeof frame.data);
    return frame;
}

static void begin(char **arg)
{
    uint8_t bytes[7 * TAXELD_MODULES_MAX];
    const size_t n = unhex(arg[3], bytes, sizeof bytes);

    memset(&hub, 0, sizeof hub);
    unhex(arg[0], hub.uid, sizeof hub.uid);
    hub.short_id = (uint8_t)strtoul(arg[1], NULL, 16);
    hub.phase = (int)strtoul(arg[2], NULL, 16);
    for (const uint8_t *d = bytes; d < bytes + n; d += 7) {
        taxeld_module *module = &hub.module[hub.modules++];

        module->sui = (uint32_t)d[0] << 24 | (uint32_t)d[1] << 16 | (uint32_t)d[2] << 8 | d[3];
        module->mask = (uint16_t)(d[4] << 8 | d[5]);
        module->channels = d[6];
    }
    taxeld_reassembler_init(&hub.own, hub.short_id);
    taxeld_reassembler_init(&hub.all, TAXELD_BROADCAST);
}

static void run(char **arg, size_t n)
{
    if (strcmp(arg[0], "device") == 0) {
        for (size_t i = 1; i < n; i++) {
            const taxeld_frame want = frame_of(arg[i]), *got = &said[n_checked++];

            CHECK(n_checked <= n_said);
            CHECK(got->id == want.id && got->len == want.len && got->extended == want.extended);
            CHECK(memcmp(got->data, want.data, want.len) == 0);
        }
        return;
    }
    if (strcmp(arg[0], "scan") == 0) {
        uint8_t bytes[2 * TAXELD_VALUES_MAX];
        uint16_t counts[TAXELD_VALUES_MAX];
        const size_t values = unhex(arg[1], bytes, sizeof bytes) / 2;

        for (size_t i = 0; i < values; i++)
            counts[i] = (uint16_t)(bytes[2 * i] << 8 | bytes[2 * i + 1]);
        scan(counts, values);
        return;
    }
    CHECK(n_checked == n_said); /* nothing was said that is not in the conversation */
    n_checked = n_said = 0;
    if (strcmp(arg[0], "hub") == 0) {
        CHECK(n == 5);
        begin(arg + 1);
    }
    for (size_t i = 1; i < n && strcmp(arg[0], "host") == 0; i++) {
        const taxeld_frame frame = frame_of(arg[i]);

        hear(&frame);
    }
}

int main(int argc, char **argv)
{
    static char text[TEXT_MAX];
    FILE *file = argc == 2 ? fopen(argv[1], "r") : NULL;

    if (!file) {
        fprintf(stderr, "usage: hub_main FILE\n");
        return 2;
    }
    while (fgets(text, sizeof text, file)) {
        char *arg[256];
        size_t n = 0;

        line_number++;
        for (char *t = strtok(text, " \n"); t; t = strtok(NULL, " \n")) {
            CHECK(n < 256);
            arg[n++] = t;
        }
        if (n)
            run(arg, n);
    }
    fclose(file);
    CHECK(line_number && n_checked == n_said);
    printf("%lu lines\n", line_number);
    return 0;
}
